# The commands that the README names. Everything lands under target/ and build/; nothing else is written.
#
#   make          the library and the command line, optimised
#   make demo     meshes a real brain atlas and draws it: see demo/
#   make test     installs what is missing and runs every check; the last line counts them
#   make bench    one CSV row per case
#   make install  PREFIX=/usr/local
#   make header   writes include/meshwright.h anew
#   make abi      writes abi/symbols.txt and abi/meshwright.abi anew, after a change that is meant
PREFIX ?= /usr/local
CARGO ?= cargo

.PHONY: all demo test bench install header abi dependencies

all:
	$(CARGO) build --release --locked

dependencies:
	scripts/install_dependencies.sh

demo:
	scripts/install_dependencies.sh demo
	$(CARGO) build --release --locked
	scripts/demo.sh

test: dependencies
	scripts/run_tests.sh

bench:
	scripts/bench.sh

install:
	cmake -S . -B build/release -DCMAKE_BUILD_TYPE=Release -DMESHWRIGHT_CARGO_TARGET_DIR=$(CURDIR)/target \
	  -DMESHWRIGHT_BUILD_TESTS=OFF -DMESHWRIGHT_BUILD_EXAMPLES=OFF -DCMAKE_INSTALL_PREFIX=$(PREFIX)
	cmake --build build/release
	cmake --install build/release

header:
	MW_UPDATE_HEADER=1 $(CARGO) test --locked --test header

abi:
	scripts/check_abi.sh --update

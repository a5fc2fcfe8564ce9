"""Lists the crates that are linked into the library and the binary, with their licences: THIRD_PARTY.md.

Usage: third_party.py OUT.md            writes the list
       third_party.py --check OUT.md    fails when the list is not current

What is linked is what `cargo tree` reports for normal dependencies on this machine; a licence is what the crate declares.
Copyright lines and texts come from the files that the crates bring.
"""
import json, os, re, subprocess, sys

TREE = ["cargo", "tree", "--locked", "--edges", "normal", "--prefix", "none", "--format", "{p}|{l}|{r}"]
# What may be linked into a library that is MIT OR Apache-2.0 without asking more of its users than a notice.
PERMITTED = {"MIT", "Apache-2.0", "Apache-2.0 WITH LLVM-exception", "BSD-2-Clause", "BSD-3-Clause", "ISC", "Zlib", "0BSD",
             "Unicode-3.0", "Unlicense", "CC0-1.0"}


def crates(*options):
    """Sorted (name, version, licence, repository) of the linked crates other than ours."""
    lines = subprocess.run(TREE + list(options), capture_output=True, text=True, check=True).stdout.splitlines()
    rows = set()
    for line in lines:
        package, licence, repository = line.replace(" (*)", "").split("|")
        name, version = package.split()[:2]
        if name != "meshwright":
            rows.add((name, version.lstrip("v"), licence.replace("/", " OR "), repository))
    return sorted(rows)


def is_permitted(licence):
    """Whether one choice of an SPDX expression without nested alternatives asks for permitted licences only."""
    choices = licence.replace("(", "").replace(")", "").split(" OR ")
    return any(all(part.strip() in PERMITTED for part in choice.split(" AND ")) for choice in choices)


def licence_files():
    """For (name, version): the texts of the licence files beside the crate's manifest, by file name."""
    command = ["cargo", "metadata", "--locked", "--format-version", "1"]
    metadata = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    files = {}
    for package in metadata["packages"]:
        folder = os.path.dirname(package["manifest_path"])
        names = sorted(n for n in os.listdir(folder) if re.match(r"(?i)(licen[cs]e|copying|unlicense|notice)", n))
        texts = {n: open(os.path.join(folder, n), encoding="utf-8", errors="replace").read() for n in names if os.path.isfile(os.path.join(folder, n))}
        files[package["name"], package["version"]] = texts
    return files


def copyright_lines(texts):
    """The lines that name the holders; not those of the licences' own wording."""
    lines = []
    for text in texts.values():
        for line in text.splitlines():
            line = line.strip(" \t#*/-")
            if re.match(r"(?i)copyright (\(c\)|©|\d{4}|the|[A-Z])", line) and not re.search(
                r"(?i)\[yyyy\]|\{yyyy\}|copyright (license|notice|owner|holder|statement|and|or|law|interest|protection)", line
            ):
                lines.append(line)
    return list(dict.fromkeys(lines))


def listing():
    library = {row[0] for row in crates("--no-default-features")}
    rows = crates()
    refused = [f"{name} {version}: {licence}" for name, version, licence, _ in rows if not is_permitted(licence)]
    if refused:
        raise SystemExit("licences that are not permitted: " + "; ".join(refused))
    lines = [
        "# Third-party software",
        "",
        "Crates that are linked into Meshwright, each under the licence it declares. The command-line program links all of them,",
        "the library those marked *. Where a crate gives the choice we take MIT, whose text stands in LICENSE-MIT with these",
        "holders in the place of ours; Apache-2.0 stands in LICENSE-APACHE; the other texts stand below.",
        "",
        "| crate | version | licence | copyright | source |",
        "|---|---|---|---|---|",
    ]
    files = licence_files()
    for name, version, licence, source in rows:
        holders = "; ".join(copyright_lines(files[name, version])) or f"the authors of {name}"
        lines.append(f"| {name}{' *' if name in library else ''} | {version} | {licence} | {holders.replace('|', '/')} | {source} |")
    for name, version, licence, _ in rows:
        if "MIT" not in licence or " AND " in licence:
            for file, text in files[name, version].items():
                if not re.search(r"(?i)apache|mit$", file):
                    lines += ["", f"## {name}: {file}", "```text", text.strip(), "```"]
    return "\n".join(lines) + "\n"


text = listing()
if sys.argv[1] == "--check":
    if open(sys.argv[2], encoding="utf-8").read() != text:
        raise SystemExit(f"{sys.argv[2]} is not current: scripts/third_party.py {sys.argv[2]}")
else:
    open(sys.argv[1], "w", encoding="utf-8").write(text)

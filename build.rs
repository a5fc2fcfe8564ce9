//! Sets the link options of the shared library.
//!
//! `-z nodelete`: a Rust library owns threads and thread-local destructors; unloading it under a running host
//! crashes (rust-lang/rust issue 91979), so the loader is told never to unmap it. The SONAME carries the ABI
//! version: `0.MINOR` before 1.0, `MAJOR` after.

fn main() {
    println!("cargo:rerun-if-changed=build.rs");
    let os = std::env::var("CARGO_CFG_TARGET_OS").unwrap_or_default();
    let major = std::env::var("CARGO_PKG_VERSION_MAJOR").unwrap_or_default();
    let minor = std::env::var("CARGO_PKG_VERSION_MINOR").unwrap_or_default();
    let abi = if major == "0" { format!("0.{minor}") } else { major };
    match os.as_str() {
        "linux" => {
            println!("cargo:rustc-cdylib-link-arg=-Wl,-soname,libmeshwright.so.{abi}");
            println!("cargo:rustc-cdylib-link-arg=-Wl,-z,nodelete");
        }
        "macos" => {
            println!("cargo:rustc-cdylib-link-arg=-Wl,-install_name,@rpath/libmeshwright.{abi}.dylib");
        }
        _ => {}
    }
}

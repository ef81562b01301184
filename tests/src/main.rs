//! The command line under test: cargo passes the path of a package's own binary to its tests.

fn main() -> std::process::ExitCode {
    clift::main()
}

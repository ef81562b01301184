//! The `clift` binary.

fn main() -> std::process::ExitCode {
    clift::main()
}

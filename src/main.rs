//! The `endofield` command.

use std::process::ExitCode;

fn main() -> ExitCode {
    endofield::cli::main()
}

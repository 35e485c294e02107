//! The `endofield` command.

fn main() -> anyhow::Result<()> {
    endofield::cli::main()
}

//! The `endofield` command.

fn main() {}

//! `tandem commands`: the help of every command on one page. `docs/commands.md` is this page.

use clap::{Command, CommandFactory as _};

use crate::cli::Cli;
use crate::columns::wrapped;
use crate::exit::Failed;
use crate::output;

/// Columns of the help texts.
const N_COLUMNS: usize = 100;
const INTRODUCTION: &str = "\
`tandem COMMAND --help` prints the same text. [Settings](settings.md) lists the settings of a run, which `--set` changes.";

/// Prints the page as Markdown.
pub(crate) fn print() -> Result<(), Failed> {
    output::print(page().trim_end())
}

fn page() -> String {
    let mut program = Cli::command().term_width(N_COLUMNS);
    program.build();
    let mut page = format!("# Commands\n\n{}\n", wrapped(INTRODUCTION, ""));
    append(&mut page, &mut program, "tandem");
    page
}

/// Appends the help of `command` and of the commands below it that help texts show.
fn append(page: &mut String, command: &mut Command, name: &str) {
    // Values of environment variables, such as the path of a token, are not part of the page.
    let help =
        command.clone().mut_args(|arg| arg.hide_env_values(true)).render_long_help().to_string();
    let lines: Vec<&str> = help.lines().map(str::trim_end).collect();
    page.push_str(&format!("\n## `{name}`\n\n```text\n{}\n```\n", lines.join("\n").trim_end()));
    for below in command.get_subcommands_mut() {
        if !below.is_hide_set() && below.get_name() != "help" {
            let name = format!("{name} {}", below.get_name());
            append(page, below, &name);
        }
    }
}

#[cfg(all(test, not(feature = "otlp")))]
mod tests {
    use super::*;

    #[test]
    fn the_page_in_the_documentation_is_current() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/docs/commands.md");
        let documented = std::fs::read_to_string(path).expect("docs/commands.md");
        assert!(documented == page(), "update it: tandem commands > docs/commands.md");
    }

    #[test]
    fn the_page_has_commands_below_commands_and_no_hidden_ones() {
        let page = page();
        assert!(page.contains("\n## `tandem bridge move`\n"));
        assert!(!page.contains("env-guard") && !page.contains("\n## `tandem help`"));
    }
}

//! The server of a run's environments, which the run directory remembers.

use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context as _, anyhow};
use serde::{Deserialize, Serialize};
use tandem_system::atomic_file;

use crate::cli::{EnvironmentArgs, TrainArgs};
use crate::environment_server::{names_server, shell_words};
use crate::exit::{Exit, Failed, OrExit as _};
use crate::input;

/// The options of the server, by their names on the command line.
#[derive(Debug, Default, Deserialize, Serialize)]
#[serde(deny_unknown_fields, default)]
struct EnvironmentFile {
    #[serde(skip_serializing_if = "Option::is_none")]
    env: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    env_command: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    env_timeout_s: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    env_token_file: Option<PathBuf>,
    #[serde(skip_serializing_if = "Option::is_none")]
    env_tls_ca: Option<PathBuf>,
}

/// Returns the options of the command line. A resumed run without a server on the command line has its former one.
pub(crate) fn environment_of(args: &TrainArgs) -> Result<EnvironmentArgs, Failed> {
    let given = args.environment.clone();
    let path = args.out.as_deref().filter(|_| args.resume).map(path_in);
    let Some(path) = path.filter(|path| !names_server(&given) && path.exists()) else {
        if given.env_timeout_s.is_some() && !names_server(&given) {
            return Err(Failed::usage("--env-timeout-s needs --env or --env-command"));
        }
        return Ok(given);
    };
    let what = || "name the server with --env or --env-command".to_owned();
    let former = read(&path).or_exit(Exit::Data, what)?;
    Ok(EnvironmentArgs { env_timeout_s: given.env_timeout_s.or(former.env_timeout_s), ..former })
}

/// Writes the options to the run directory `out`, unless they are stored there. Options that name no server remove
/// those of an earlier run.
pub(crate) fn keep(args: &EnvironmentArgs, out: &Path) -> Result<(), Failed> {
    let path = path_in(out);
    let what = || format!("cannot write {}", path.display());
    if !names_server(args) {
        return match std::fs::remove_file(&path) {
            Err(error) if error.kind() != ErrorKind::NotFound => Err(error).or_cannot_write(what),
            _ => Ok(()),
        };
    }
    if read(&path).is_ok_and(|stored| stored == *args) {
        return Ok(());
    }
    let text = toml::to_string(&EnvironmentFile::from(args)).or_exit(Exit::Usage, what)?;
    atomic_file::replace(&path, text.as_bytes()).or_cannot_write(what)
}

/// Returns the options of the server of the run in `out`, as a shell takes them, if the run remembers one.
pub(crate) fn server_options(out: &Path) -> Option<String> {
    let args = read(&path_in(out)).ok()?;
    names_server(&args).then(|| shell_words(&args))
}

fn path_in(out: &Path) -> PathBuf {
    out.join("environment.toml")
}

fn read(path: &Path) -> anyhow::Result<EnvironmentArgs> {
    let text = input::text(path).with_context(|| format!("cannot read {path:?}"))?;
    let file: EnvironmentFile = toml::from_str(&text)
        .map_err(|error| anyhow!("{path:?} is damaged: {}", error.message().replace('\n', " ")))?;
    let timeout = file.env_timeout_s.map(Duration::try_from_secs_f64).transpose();
    Ok(EnvironmentArgs {
        env: file.env,
        env_command: file.env_command,
        env_timeout_s: timeout.with_context(|| format!("{path:?} is damaged: env_timeout_s"))?,
        env_token_file: file.env_token_file,
        env_tls_ca: file.env_tls_ca,
    })
}

impl From<&EnvironmentArgs> for EnvironmentFile {
    /// Makes paths absolute, so that a run can be resumed from any directory.
    fn from(args: &EnvironmentArgs) -> Self {
        let absolute = |path: &PathBuf| std::path::absolute(path).unwrap_or_else(|_| path.clone());
        Self {
            env: args.env.clone(),
            env_command: args.env_command.clone(),
            env_timeout_s: args.env_timeout_s.map(|timeout| timeout.as_secs_f64()),
            env_token_file: args.env_token_file.as_ref().map(absolute),
            env_tls_ca: args.env_tls_ca.as_ref().map(absolute),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn options_are_read_back_until_a_run_has_no_server() {
        let out = tempfile::tempdir().expect("a directory");
        let path = path_in(out.path());
        let command = EnvironmentArgs {
            env_command: Some("serve --name \"it's\" | tee log".to_owned()),
            env_timeout_s: Some(Duration::from_millis(1500)),
            ..EnvironmentArgs::default()
        };
        let address = EnvironmentArgs {
            env: Some("https://lab:7005".to_owned()),
            env_token_file: Some("/run/token".into()),
            env_tls_ca: Some("/run/ca.pem".into()),
            ..EnvironmentArgs::default()
        };
        for args in [command, address] {
            keep(&args, out.path()).expect("writes");
            assert_eq!(read(&path).expect("complete"), args);
            let options = server_options(out.path()).expect("a server");
            assert!(match args.env_command {
                Some(_) => {
                    let command = r#"--env-command 'serve --name "it'\''s" | tee log'"#;
                    options == format!("{command} --env-timeout-s 1.5")
                }
                None => {
                    let files = "--env-token-file /run/token --env-tls-ca /run/ca.pem";
                    options == format!("--env https://lab:7005 {files}")
                }
            });
        }
        let none = EnvironmentArgs::default();
        keep(&none, out.path()).expect("removes");
        assert!(!path.exists());
        keep(&none, out.path()).expect("nothing to remove");
    }

    #[test]
    fn a_damaged_file_is_reported_on_one_line() {
        let out = tempfile::tempdir().expect("a directory");
        let path = path_in(out.path());
        for text in ["env = ", "port = 7005", "env_timeout_s = -1.0"] {
            std::fs::write(&path, text).expect("writes");
            let line = format!("{:#}", read(&path).expect_err("damaged"));
            assert!(line.contains("is damaged: ") && !line.contains('\n'), "{line}");
        }
    }
}

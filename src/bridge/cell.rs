//! The cell file of a bridge: loading, printing, and what real arms need.

use std::path::Path;

use serde_json::json;
use tandem_bridge::Settings;
use tandem_bridge::cell_file::{CellFile, DEFAULT_TEXT};

use super::arms;
use crate::cli::{CellArgs, DriverName};
use crate::exit::{Exit, Failed, OrExit as _};
use crate::{input, output};

/// The cell of a bridge.
pub(super) struct Cell {
    pub(super) file: CellFile,
    /// The path on the command line; empty for the default cell.
    pub(super) name: String,
}

impl Cell {
    /// Loads the cell file at `path`, or returns the default cell.
    pub(super) fn load(path: Option<&Path>) -> Result<Self, Failed> {
        let Some(path) = path else {
            return Ok(Self { file: CellFile::default(), name: String::new() });
        };
        let file = CellFile::parse(&text(path)?);
        let file = file.or_exit(Exit::Data, || format!("cell file {path:?}"))?;
        Ok(Self { file, name: path.display().to_string() })
    }

    /// Returns the limits and deadlines of the arms behind `driver`.
    pub(super) fn settings(&self, driver: DriverName) -> Settings {
        self.file.settings(&arms::default_settings(driver))
    }

    /// Returns the names of the arms whose times were not measured.
    fn unmeasured(&self) -> Vec<&str> {
        let arms = self.file.arms.iter().filter(|arm| !arm.is_measured());
        arms.map(|arm| arm.name.as_str()).collect()
    }

    /// Refuses to move real arms whose bases are guesses.
    pub(super) fn require_places(&self) -> Result<(), Failed> {
        if !self.name.is_empty() {
            return Ok(());
        }
        Err(Failed::usage(
            "real arms need a cell file: write one with `tandem bridge cell > cell.toml`, enter where the arms stand, \
             and give --cell cell.toml",
        ))
    }

    /// Refuses to move real arms by guesses, unless the operator accepts them.
    pub(super) fn require_measured(
        &self,
        driver: DriverName,
        accept_defaults: bool,
    ) -> Result<(), Failed> {
        if driver == DriverName::Sim || accept_defaults {
            return Ok(());
        }
        if self.name.is_empty() {
            return Err(Failed::usage(
                "real arms need a cell file: write one with `tandem bridge cell > cell.toml`, enter where the arms \
                 stand, and measure with `tandem bridge calibrate` (--accept-defaults moves them by guesses)",
            ));
        }
        match self.unmeasured().as_slice() {
            [] => Ok(()),
            arms => Err(Failed::usage(format!(
                "cell file {:?} has no lag_s, reaction_s and brake_s of {}: measure with `tandem bridge calibrate` \
                 (--accept-defaults moves real arms by guesses)",
                self.name,
                arms.join(" and ")
            ))),
        }
    }
}

/// Reads the text of a cell file.
pub(super) fn text(path: &Path) -> Result<String, Failed> {
    input::text(path).or_exit(Exit::Data, || format!("cannot read cell file {path:?}"))
}

/// Prints the default cell file, or checks one.
pub(super) fn cell(args: &CellArgs) -> Result<(), Failed> {
    let Some(path) = &args.file else {
        return output::print(DEFAULT_TEXT.trim_end());
    };
    let cell = Cell::load(Some(path))?;
    let unmeasured = cell.unmeasured();
    if args.json {
        let names: Vec<&str> = cell.file.arms.iter().map(|arm| arm.name.as_str()).collect();
        return output::print(json!({"valid": true, "arms": names, "not_measured": unmeasured}));
    }
    output::print("the cell file is valid")?;
    if unmeasured.is_empty() {
        return output::print("all times were measured");
    }
    output::print(format_args!("not measured: {}", unmeasured.join(", ")))
}

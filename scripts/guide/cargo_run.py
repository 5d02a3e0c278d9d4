"""Stands in for `cargo` while the guide is tested: `cargo run` starts what is built already."""

import os
import sys
from pathlib import Path


def main(arguments: list[str]) -> None:
    if arguments[:2] != ["run", "--release"]:
        raise SystemExit(f"cargo {' '.join(arguments)}: only `cargo run --release` is executed")
    passed = arguments[arguments.index("--") + 1 :] if "--" in arguments else []
    if "--example" in arguments:
        # Cargo puts examples beside the program.
        example = Path(os.environ["GUIDE_PROGRAM"]).parent / "examples" / arguments[arguments.index("--example") + 1]
        os.execv(example, [str(example), *passed])
    os.execvp("tandem", ["tandem", *passed])


if __name__ == "__main__":
    main(sys.argv[1:])

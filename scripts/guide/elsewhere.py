"""Commands of the guide that `scripts/test-guide` does not execute, and where they are tested instead.

An entry that fits no command of the guide is an error, as is an entry whose file does not exist. Options and
subcommands of `tandem` are compared with `--help` for these commands too.
"""

import shlex
from dataclasses import dataclass

from pages import ROOT, Command, simple_commands


@dataclass(frozen=True)
class Entry:
    """The first words of a command, why it is not executed, and the file that tests it ("" if none does)."""

    words: str
    reason: str
    where: str
    page: str = ""

    def fits(self, command: Command) -> bool:
        if self.page and command.page != self.page:
            return False
        words = shlex.split(self.words)
        return any(part[: len(words)] == words for part in simple_commands(command.text))


SERVED = "python/tests/test_environment_server.py"
PAIR = "python/tests/test_two_fetch.py"
REPLAYED = "worker/tests/services/environments.rs"
ELSEWHERE = [
    # Programs that need another machine, a registry or hardware.
    Entry("docker", "needs Docker", "scripts/test-compose"),
    Entry("tandem health", "asks a service in a container", "scripts/test-compose", "docs/compose.md"),
    Entry("tandem status", "asks a service in a container", "scripts/test-compose", "docs/compose.md"),
    Entry("tandem bridge status", "asks a service in a container", "scripts/test-compose", "docs/compose.md"),
    Entry("grpcurl", "is not in Debian; the tests use reflection", "tests/access.rs"),
    Entry("kubectl", "needs a cluster; the manifests' commands run as processes", "tests/kubernetes.rs"),
    Entry("curl", "asks a service in a cluster", "tests/kubernetes.rs", "docs/cluster.md"),
    Entry("tandem bridge calibrate", "takes 46 s of real time", "bridge/tests/pair/calibration.rs"),
    Entry("cc", "needs a C compiler", "scripts/test-quarc"),
    Entry("./simulated_pair", "is compiled by the command before", "scripts/test-quarc"),
    Entry("tandem bridge --driver quarc", "needs the compiled arms", "scripts/test-quarc", "docs/drivers.md"),
    Entry("ssh", "needs another machine", ""),
    Entry("tandem relay", "has the names of several machines", "learner/tests/service/relay.rs", "docs/scale.md"),
    Entry("tandem worker", "has the names of several machines", "learner/tests/service/relay.rs", "docs/scale.md"),
    Entry("pip install", "needs a package registry", "scripts/test-python"),
    Entry("tensorboard", "needs a package of PyPI", "scripts/test-metrics"),
    # Programs that need the Python package, MuJoCo or PyTorch.
    Entry("python -m tandem.serve", "needs the Python package", SERVED),
    Entry("tandem eval --policy FILE", "needs MuJoCo", SERVED, "docs/environments.md"),
    Entry("tandem train --env-command 'python -m tandem.serve FetchPush-v4'", "needs MuJoCo", SERVED),
    Entry("tandem train --env-command 'python -m tandem.serve FetchPush-v4 --reflection fetch'", "needs MuJoCo", PAIR),
    Entry("tandem train --env-command 'python -m tandem.serve tandem/TwoFetchPush-v0'", "needs MuJoCo", PAIR),
    Entry("python scripts/benchmarks.py run", "trains for hours", ""),
    Entry("python scripts/benchmarks.py composed", "evaluates a teacher that takes hours", ""),
    Entry("python scripts/benchmarks.py collect", "collects what took hours", ""),
    Entry("python scripts/plot_benchmarks.py", "needs matplotlib", ""),
    Entry("python scripts/bench_sb3.py", "needs PyTorch and trains for hours", ""),
    Entry("python scripts/mujoco_transfer.py", "needs MuJoCo", "scripts/smoke.sh"),
    Entry("python scripts/failures.py", "needs the Python package", "scripts/test-python"),
    Entry("scripts/table-2", "writes a page of the guide", ".ci/run"),
    # A program that is built in another way.
    Entry("target/release/tandem train", "needs the feature otlp", "tests/otlp.rs"),
    Entry("scripts/build-demo", "compiles for WebAssembly", "scripts/test-demo"),
    Entry("python3 -m http.server -d docs/demo", "needs the built demo", "tests/demo/check.py"),
    Entry("cargo run --release --manifest-path demo/Cargo.toml", "compiles for minutes", "scripts/test-demo"),
    # Steps of the continuous integration, and what takes longer.
    Entry(".ci/run", "runs this test", ".ci/run"),
    Entry("scripts/test-guide", "is this test", ".ci/run"),
    Entry("cargo build", "a step of its own", ".ci/run"),
    Entry("cargo test", "a step of its own", ".ci/run"),
    Entry("cargo mutants", "takes hours", ".cargo/mutants.toml"),
    Entry("cargo install --locked --path .", "compiles the program again", ""),
    Entry("cargo install cargo-mutants", "needs a package registry", ""),
    Entry("scripts/fuzz", "a step of its own", ".ci/run"),
    Entry("fuzz/target/x86_64-unknown-linux-gnu/release/log", "minimises an input that makes a decoder fail", ""),
    Entry("cp minimized-from-...", "minimises an input that makes a decoder fail", ""),
    Entry("scripts/make-corpus", "writes files of a new version", "tests/compatibility"),
    # Servers of the reader's own.
    Entry("tandem replay", "needs a server of another task", REPLAYED, "docs/episode-logs.md"),
]


def entry_for(command: Command) -> Entry | None:
    return next((entry for entry in ELSEWHERE if entry.fits(command)), None)


def unfit_entries(every: list[Command]) -> list[str]:
    """Returns a line for each entry that fits no command, or whose file does not exist."""
    unused = [entry for entry in ELSEWHERE if not any(entry.fits(command) for command in every)]
    lost = [entry for entry in ELSEWHERE if entry.where and not (ROOT / entry.where).exists()]
    return [
        *(f"scripts/guide/elsewhere.py: no command of the guide begins with {entry.words!r}" for entry in unused),
        *(f"scripts/guide/elsewhere.py: {entry.where!r} does not exist" for entry in lost),
    ]

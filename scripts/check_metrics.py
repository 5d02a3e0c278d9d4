"""Checks the metrics of all services in a short run; scripts/test-metrics calls it.

Usage: check_metrics.py [--write] PROGRAM       --write updates the table of docs/metrics.md

Starts a teacher, a learner, a relay, an environment server, a bridge, two workers and a Prometheus that scrapes them.
"""

import json
import pathlib
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.parse
import urllib.request

import yaml

ROOT = pathlib.Path(__file__).resolve().parent.parent
DEADLINE_S = 120
COMPONENTS = ("learner", "teacher", "worker", "relay", "environment", "bridge")
RUN_FILE = """
name = "metrics"
task = "push"
arms = 2
seed = 5
[advice]
strategy = "mc-q:0.1"
budget = 8_000
[rounds]
slots = 4
rollouts = 2
updates_per_env_step = 0.1
[ddpg]
n_hidden = 32
[evaluation]
every_env_steps = 800
episodes = 8
recorded_episodes = 0
[checkpoint]
every_rounds = 8
[stop]
max_env_steps = 2_000_000
"""


def free_port():
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


def get(address, path, **query):
    url = f"http://{address}{path}" + ("?" + urllib.parse.urlencode(query) if query else "")
    with urllib.request.urlopen(url, timeout=10) as response:
        return response.read().decode()


def wait_for(what, condition):
    """Repeats `condition` until it returns a true value, and returns that."""
    deadline = time.monotonic() + DEADLINE_S
    while time.monotonic() < deadline:
        try:
            value = condition()
        except (OSError, ValueError):
            value = None
        if value:
            return value
        time.sleep(0.2)
    sys.exit(f"not in {DEADLINE_S} s: {what}")


class Service:
    """A process of the run. Its page of metrics has the same address after a restart."""

    def __init__(self, program, work, name, component, *arguments):
        self.name, self.component, self.log = name, component, work / f"{name}.log"
        self.metrics_at = f"127.0.0.1:{free_port()}"
        self.command = [program, component if component != "environment" else "env", *arguments, "--metrics-listen", self.metrics_at]
        self.start()

    def start(self, *more):
        with self.log.open("ab") as log:
            self.process = subprocess.Popen([*self.command, *more], stdout=subprocess.PIPE, stderr=log, stdin=subprocess.DEVNULL, text=True)

    def address(self):
        line = self.process.stdout.readline()
        if not line.startswith("listening on "):
            sys.exit(f"{self.name} does not listen: {self.log.read_text()}")
        return line.removeprefix("listening on ").removeprefix("http://").strip()

    def page(self):
        return get(self.metrics_at, "/metrics")


class Run:
    """All services, in a directory of their own."""

    def __init__(self, program, work):
        self.program, self.out = program, work / "run"
        self.services = []
        run_file = work / "run.toml"
        run_file.write_text(RUN_FILE)

        def start(name, component, *arguments):
            service = Service(program, work, name, component, *arguments)
            self.services.append(service)
            return service

        teacher_at = start("teacher", "teacher", "--policy", ROOT / "policies/teacher-push-classic.safetensors", "--ledger", work / "ledger.sqlite").address()
        # The learner keeps its port, so that workers find it after a restart.
        learner_at = f"127.0.0.1:{free_port()}"
        self.learner = start(
            "learner", "learner", "--run", run_file, "--out", self.out, "--teacher", teacher_at, "--listen", learner_at, "--start-or-resume", "--stay"
        )
        self.learner.address()
        relay_at = start("relay", "relay", "--connect", learner_at).address()
        environment_at = start("environment", "environment", "--world", "classic", "--max-environments", "64").address()
        bridge_at = start("bridge", "bridge", "--driver", "sim", "--listen", "127.0.0.1:0").address()
        start("worker-1", "worker", "--connect", learner_at, "--teacher", teacher_at, "--env", environment_at)
        start("worker-2", "worker", "--connect", relay_at, "--teacher", teacher_at, "--env", environment_at)
        for address in (teacher_at, learner_at, relay_at, environment_at, bridge_at):
            subprocess.run([program, "health", address], check=True, stdout=subprocess.DEVNULL)

    def rows(self):
        path = self.out / "metrics.jsonl"
        return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []

    def crash_learner(self):
        """Kills the learner after evaluations that no checkpoint contains, and starts it again."""
        def evaluations_since_the_checkpoint():
            # Checkpoints are named after their rounds.
            rows = self.rows()
            saved = [int(re.sub(r"\D", "", path.stem)) for path in (self.out / "checkpoint").glob("*.safetensors")]
            return saved and rows and rows[-1]["round"] > max(saved)

        wait_for("an evaluation after a checkpoint", evaluations_since_the_checkpoint)
        self.learner.process.kill()
        self.learner.process.wait()
        n_rows = len(self.rows())
        self.learner.start()
        self.learner.address()
        wait_for("two further evaluations", lambda: len(self.rows()) >= n_rows + 2)

    def end(self):
        for service in self.services:
            if service.process.poll() is None:
                service.process.send_signal(signal.SIGTERM)
        for service in self.services:
            try:
                service.process.wait(timeout=20)
            except subprocess.TimeoutExpired:
                service.process.kill()


class Prometheus:
    """A Prometheus with the rules of deploy/prometheus and the services of a run as targets."""

    def __init__(self, work, services):
        self.address = f"127.0.0.1:{free_port()}"
        config = yaml.safe_load((ROOT / "deploy/prometheus/prometheus.yml").read_text())
        config["global"] = {"scrape_interval": "1s", "scrape_timeout": "1s", "evaluation_interval": "1s"}
        config["rule_files"] = [str(ROOT / "deploy/prometheus/alerts.yml")]
        jobs = {job["job_name"]: job for job in config["scrape_configs"]}
        expect(set(jobs) == {f"tandem-{name}" for name in COMPONENTS}, f"prometheus.yml has jobs {sorted(jobs)}")
        for name, job in jobs.items():
            targets = [service.metrics_at for service in services if f"tandem-{service.component}" == name]
            job["static_configs"] = [{"targets": targets}]
        path = work / "prometheus.yml"
        path.write_text(yaml.safe_dump(config))
        command = ["prometheus", f"--config.file={path}", f"--storage.tsdb.path={work / 'tsdb'}", f"--web.listen-address={self.address}"]
        self.process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=(work / "prometheus.log").open("wb"))

    def query(self, expression):
        answer = json.loads(get(self.address, "/api/v1/query", query=expression))
        return answer["data"]["result"]

    def are_all_scraped(self, n_targets, since_s):
        window_s = int(time.monotonic() - since_s)
        return window_s > 0 and len(self.query(f"count_over_time(up[{window_s}s]) >= 3 and up == 1")) == n_targets

    def rules(self):
        groups = json.loads(get(self.address, "/api/v1/rules"))["data"]["groups"]
        return [rule for group in groups for rule in group["rules"]]

    def end(self):
        self.process.terminate()
        self.process.wait()


failures = []


def expect(holds, message):
    if not holds:
        failures.append(message)


def exposed(services):
    """Returns type, help and components of every exposed metric, and all names of samples."""
    metrics, samples = {}, {"up"}
    for service in services:
        kinds = {}
        for line in service.page().splitlines():
            if line.startswith("# HELP "):
                _, _, name, text = line.split(" ", 3)
                kinds[name] = text.rstrip(".")
            elif line.startswith("# TYPE "):
                _, _, name, kind = line.split(" ")
                shown = f"{name}_total" if kind == "counter" else f"{name}_info" if kind == "info" else name
                metric = metrics.setdefault(shown, {"type": kind, "help": kinds.get(name, ""), "components": set()})
                metric["components"].add(service.component)
            elif not line.startswith("#"):
                samples.add(re.split(r"[{ ]", line)[0])
    return metrics, samples


def check_names(metrics):
    """Checks the conventions of Prometheus for names and units."""
    for name, metric in metrics.items():
        expect(re.fullmatch(r"(tandem|process)_[a-z][a-z0-9_]*", name), f"{name} is not a name of ours")
        expect(not re.search(r"_(ms|millis|micros|us|minutes|mib|kib|percent)(_|$)", name), f"{name} is not in a base unit")
        expect(metric["help"], f"{name} has no help")
        is_counter = metric["type"] == "counter"
        expect(is_counter == name.endswith("_total"), f"{name} is a {metric['type']}")


def check_table(metrics, write):
    """Compares the table of docs/metrics.md with the exposed metrics, or updates it."""
    path = ROOT / "docs/metrics.md"
    lines = path.read_text().splitlines()
    table = []
    for name, metric in sorted(metrics.items(), key=lambda item: (item[0].startswith("process"), item[0])):
        components = "all" if metric["components"] == set(COMPONENTS) else ", ".join(c for c in COMPONENTS if c in metric["components"])
        table.append(f"| `{name}` | {metric['type']} | {components} | {metric['help']} |")
    is_row = [bool(re.match(r"\| `(tandem|process)_", line)) for line in lines]
    if write:
        rest = [line for line, row in zip(lines, is_row) if not row]
        first = rest.index("| metric | type | service | meaning |") + 2
        path.write_text("\n".join(rest[:first] + table + rest[first:]) + "\n")
        return
    known = [line for line, row in zip(lines, is_row) if row]
    for line in sorted(set(table) ^ set(known)):
        expect(False, f"docs/metrics.md {'lacks' if line in table else 'has, but nothing exposes,'} {line}")


def dashboard_expressions():
    dashboard = json.loads((ROOT / "deploy/grafana/tandem.json").read_text())
    for panel in dashboard["panels"]:
        for target in panel.get("targets", []):
            yield panel["title"], target["expr"].replace("$__rate_interval", "1m")


def check_expressions(prometheus, samples):
    """Evaluates every expression of the dashboard and the alerts."""
    n_panels = 0
    for title, expression in dashboard_expressions():
        n_panels += 1
        expect("$" not in expression, f"panel {title!r} has an unknown variable: {expression}")
        expect(prometheus.query(expression), f"panel {title!r} is empty: {expression}")
    rules = prometheus.rules()
    alerts = yaml.safe_load((ROOT / "deploy/prometheus/alerts.yml").read_text())
    n_alerts = sum(len(group["rules"]) for group in alerts["groups"])
    expect(len(rules) == n_alerts, f"Prometheus has {len(rules)} of {n_alerts} alerts")
    for rule in rules:
        expect(rule["health"] == "ok", f"alert {rule['name']}: {rule['health']} {rule.get('lastError', '')}")
        for name in re.findall(r"\b(?:tandem|process)_[a-z_]+", rule["query"]):
            expect(name in samples, f"alert {rule['name']} uses {name}, which nothing exposes")
    firing = [rule["name"] for rule in rules if rule["state"] == "firing"]
    expect(not firing, f"a run without faults fires {firing}")
    return n_panels, n_alerts


def check_histograms(prometheus):
    """Checks that every histogram has counted something, with a clock that advances."""
    counts = {item["metric"]["__name__"]: float(item["value"][1]) for item in prometheus.query('sum by (__name__) ({__name__=~"tandem_.+_seconds_(count|sum)"})')}
    for name, value in counts.items():
        expect(value > 0, f"{name} is {value} after a run")


def check_events(run):
    """Checks that TensorBoard reads each evaluation exactly once, with the values of metrics.jsonl."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    directory = run.out / "tensorboard"
    accumulator = EventAccumulator(str(directory), size_guidance={"scalars": 0})
    accumulator.Reload()
    rows = run.rows()
    tags = {
        "evaluation/success": "success",
        "evaluation/success_without_contact": "success_without_contact",
        "loss/critic": "critic_loss",
        "q/mean": "mean_q",
        "advice/spent": "advice_spent",
        "advice/queries": "advice_queries",
    }
    for tag, key in tags.items():
        events = accumulator.Scalars(tag)
        expected = [(row["env_steps"], row[key]) for row in rows if row.get(key) is not None]
        expect([event.step for event in events] == [step for step, _ in expected], f"{tag}: steps {[event.step for event in events]}")
        near = all(abs(event.value - value) <= 1e-5 * max(1.0, abs(value)) for event, (_, value) in zip(events, expected))
        expect(near, f"{tag} differs from {key} in metrics.jsonl")
        times = [event.wall_time for event in events]
        expect(times == sorted(times) and abs(times[-1] - time.time()) < 600, f"{tag}: wall times {times}")
    expect(len(list(directory.iterdir())) == 1, "several event files")
    return len(rows)


def main():
    arguments = sys.argv[1:]
    write = "--write" in arguments
    (program,) = [argument for argument in arguments if argument != "--write"]
    started = time.monotonic()
    for command in (["promtool", "check", "config", ROOT / "deploy/prometheus/prometheus.yml"],
                    ["promtool", "check", "config", ROOT / "deploy/prometheus/compose.yml"], ["promtool", "test", "rules", ROOT / "deploy/prometheus/alerts_test.yml"]):
        checked = subprocess.run(command, capture_output=True, text=True)
        expect(checked.returncode == 0, checked.stdout + checked.stderr)
    with tempfile.TemporaryDirectory() as directory:
        work = pathlib.Path(directory)
        run = Run(program, work)
        prometheus = Prometheus(work, run.services)
        try:
            run.crash_learner()
            # The learner exposes these metrics once it has values for them.
            for name in ("tandem_environment_deterministic", "tandem_best_evaluation_success_ratio"):
                wait_for(name, lambda name=name: f"\n{name} " in run.learner.page())
            wait_for("a checkpoint of the restarted learner", lambda: re.search(r"\ntandem_checkpoint_seconds_count [1-9]", run.learner.page()))
            since_s = time.monotonic()
            wait_for("three scrapes of all services", lambda: prometheus.are_all_scraped(len(run.services), since_s))
            metrics, samples = exposed(run.services)
            check_names(metrics)
            check_table(metrics, write)
            n_panels, n_alerts = check_expressions(prometheus, samples)
            check_histograms(prometheus)
            run.end()
            n_events = check_events(run)
        finally:
            prometheus.end()
            run.end()
            if failures:
                for service in run.services:
                    print(f"-- {service.name}\n" + "\n".join(service.log.read_text().splitlines()[-5:]), file=sys.stderr)
    for failure in failures:
        print(f"failed: {failure}", file=sys.stderr)
    if failures:
        sys.exit(1)
    print(f"{len(metrics)} metrics, {n_panels} expressions of the dashboard, {n_alerts} alerts, {n_events} evaluations in TensorBoard ({time.monotonic() - started:.0f} s)")


if __name__ == "__main__":
    main()

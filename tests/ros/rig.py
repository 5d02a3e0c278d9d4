"""The processes of a test over a ROS master: the master, two arm nodes, the relay and the built program."""

import json
import os
import pathlib
import signal
import socket
import subprocess
import sys
import time

import messages

HERE = pathlib.Path(__file__).parent
ROOT = HERE.parent.parent
SIDES = ["left", "right"]
# Limit of every wait, seconds.
TIMEOUT_S = 60.0


class Busy(Exception):
    """The bridge has correctly stopped the arms because this machine is too busy."""


# Stop causes that a busy machine may trigger. Late commands leave gaps in which the arms rest.
BUSY = {
    "late", "owner-silent", "state-old", "state-stale", "command-lost", "tracking", "frozen", "not-settled",
}


def until(what, condition):
    """Waits until `condition` returns a true value, and returns it."""
    end_s = time.monotonic() + TIMEOUT_S
    while time.monotonic() < end_s:
        if found := condition():
            return found
        time.sleep(0.02)
    raise AssertionError(f"{what}: not in {TIMEOUT_S:.0f} s")


def raise_priority():
    """Requests real-time scheduling where it is permitted, because the arms run at 100 Hz."""
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(5))
    except OSError:
        pass


class Record:
    """The record of a node."""

    def __init__(self, path):
        self.path = path

    def lines(self, what, since_s=0.0):
        with open(self.path) as file:
            entries = [json.loads(line) for line in file if line.endswith("\n")]
        return [line for line in entries if line[0] == what and line[1] >= since_s]

    def last_state(self):
        return until("a state", lambda: self.lines("state")[-1:])[0]


class Rig:
    def __init__(self, tandem, work):
        self.tandem_path, self.work = tandem, work
        self.running = {}
        self.relay_port = "0"
        messages.generate(work / "modules")
        self.records = [Record(work / f"{side}.jsonl") for side in SIDES]
        for record in self.records:
            record.path.touch()
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.master_port = probe.getsockname()[1]
        self.environment = {
            **os.environ,
            "ROS_MASTER_URI": f"http://127.0.0.1:{self.master_port}",
            "ROS_IP": "127.0.0.1",
            "ROS_HOME": str(work),
            "ROS_LOG_DIR": str(work),
            "PYTHONPATH": f"{work / 'modules'}:{HERE}",
        }
        self.environment.pop("ROS_HOSTNAME", None)
        self.environment.pop("TANDEM_TOKEN_FILE", None)

    def start(self, name, command, prefix=None):
        """Starts a program. If `prefix` is given, waits for a line that starts with it and returns the rest."""
        log = open(self.work / f"{name}.log", "a")
        output = subprocess.PIPE if prefix else log
        running = subprocess.Popen(
            command, cwd=ROOT, env=self.environment, stdin=subprocess.DEVNULL, stdout=output, stderr=log, text=True,
            preexec_fn=raise_priority,
        )
        self.running[name] = running
        line = running.stdout.readline() if prefix else ""
        assert line.startswith(prefix or ""), f"{name} did not start:\n{(self.work / f'{name}.log').read_text()}"
        return line.removeprefix(prefix or "").strip()

    def start_master(self):
        self.start("master", ["/usr/bin/rosmaster", "--core", "-p", str(self.master_port)])

        def answers():
            with socket.socket() as probe:
                return probe.connect_ex(("127.0.0.1", self.master_port)) == 0

        until("the master listens", answers)

    def start_node(self, arm, *times):
        """Starts an arm's node, with the interval of its status timer and the duration of a call of its arm's interface, seconds."""
        start_s = time.monotonic()
        record = self.records[arm]
        self.start(SIDES[arm], ["env", f"ROS_NAMESPACE=/{SIDES[arm]}", sys.executable, HERE / "arm_node.py", record.path, *map(str, times)])
        until("the node publishes states", lambda: record.lines("status", start_s))

    def start_relay(self):
        """Starts the relay. A restart uses the same port."""
        command = [sys.executable, HERE / "relay.py", self.relay_port]
        self.relay_port = self.start("relay", command, "listening on ")
        self.arms_at = f"ws://127.0.0.1:{self.relay_port}"

    def start_bridge(self):
        command = [self.tandem_path, "bridge", "--driver", "kinova-ros", "--arms-at", self.arms_at, "--accept-defaults"]
        self.address = self.start("bridge", [*command, "--listen", "127.0.0.1:0"], "listening on ")

    def signal(self, name, sent):
        self.running[name].send_signal(sent)

    def kill(self, name):
        """Kills a program and returns the time."""
        at_s = time.monotonic()
        self.signal(name, signal.SIGKILL)
        self.running.pop(name).wait()
        return at_s

    def logs(self):
        """Returns the ends of the programs' logs."""
        logs = [(name, self.work / f"{name}.log") for name in ("bridge", "relay", *SIDES)]
        return "\n".join(f"{name}:\n{path.read_text()[-2000:]}" for name, path in logs if path.exists())

    def end(self):
        for running in self.running.values():
            running.send_signal(signal.SIGCONT)
            running.kill()
            running.wait()

    def command(self, *what):
        return [self.tandem_path, "bridge", *map(str, what), "--connect", self.address]

    def tandem(self, *what):
        return subprocess.run(self.command(*what), cwd=ROOT, capture_output=True, text=True, check=False)

    def alone(self, *what):
        """Runs a command of `tandem bridge` that needs no bridge."""
        command = [self.tandem_path, "bridge", *map(str, what)]
        return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)

    def spawn(self, *what):
        return subprocess.Popen(
            self.command(*what), cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )

    def status(self):
        result = self.tandem("status", "--json")
        assert result.returncode == 0, result.stderr
        return json.loads(result.stdout)

    def reset(self):
        """Resets the arms as soon as they are ready and waits until both nodes are started."""

        def done():
            result = self.tandem("reset")
            assert result.returncode in (0, 75), result.stderr
            return result.returncode == 0

        until("reset", done)
        until("both nodes are started", lambda: all(self.starts()) or self.status()["stopped"])

    def starts(self):
        """Yields for each arm whether its latest event is a start."""
        for record in self.records:
            events = record.lines("start") + record.lines("stop")
            yield max(events, key=lambda line: line[1])[0] == "start" if events else False

    def unless_busy(self, stopped):
        if stopped and stopped["name"] in BUSY:
            raise Busy(stopped["sentence"])
        assert not stopped, stopped["sentence"]

    def with_arms(self, work):
        """Resets the arms and runs `work`. Repeats if a busy machine stops them."""
        for _ in range(8):
            self.reset()
            try:
                return work()
            except Busy as busy:
                print(f"    retrying, this machine was busy: {busy}", flush=True)
        raise AssertionError("this machine is too busy")

    def moving(self, speed=0.1):
        """Starts a motion and returns once the arms have moved for a second."""
        start_s = time.monotonic()
        mover = self.spawn("move", "deploy/first-motion.json", "--speed", speed)

        def are_moving():
            if mover.poll() is not None:
                self.unless_busy(self.status()["stopped"])
                raise AssertionError(mover.stderr.read())
            return all(
                sum(any(rates) for _, _, _, rates, _, _ in record.lines("state", start_s)) > 100
                for record in self.records
            )

        until("the arms move", are_moving)
        return mover

    def rest(self, since_s, arms=(0, 1)):
        """Waits until the arms have rested for a second. Returns how long (seconds) and how far (degrees) they moved after `since_s`."""
        records = [self.records[arm] for arm in arms]

        def are_at_rest():
            last = [record.lines("state", time.monotonic() - 1.0) for record in records]
            enough = all(len(states) > 20 for states in last)
            return enough and not any(any(state[3]) for states in last for state in states)

        until("the arms rest", are_at_rest)
        moved_s, moved_deg = 0.0, 0.0
        for record in records:
            states = record.lines("state", since_s)
            moved_s = max([moved_s] + [at_s - since_s for _, at_s, _, rates, _, _ in states if any(rates)])
            first, last = states[0][2], states[-1][2]
            moved_deg = max([moved_deg] + [abs(a - b) for a, b in zip(first, last)])
        return moved_s, moved_deg

"""What a test over a ROS master runs: the master, two nodes of arms, the relay, and the built program."""

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
# Longer than anything takes, seconds.
PATIENCE_S = 60.0


class Busy(Exception):
    """The bridge has stopped the arms because this machine is busy with other things, as it should."""


# What a busy machine may stop the arms for. Commands that come late leave gaps in which these arms stand.
BUSY = {
    "late", "owner-silent", "state-old", "state-stale", "command-lost", "tracking", "frozen", "not-settled",
}


def until(what, so):
    """Waits until something is so, and gives it."""
    end_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < end_s:
        if found := so():
            return found
        time.sleep(0.02)
    raise AssertionError(f"{what}: not in {PATIENCE_S:.0f} s")


def be_in_time():
    """Runs before what other programs want to do, where that is allowed: 100 Hz is the arms' own rate."""
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(5))
    except OSError:
        pass


class Record:
    """What a node has written down."""

    def __init__(self, path):
        self.path = path

    def lines(self, what, since_s=0.0):
        with open(self.path) as file:
            told = [json.loads(line) for line in file if line.endswith("\n")]
        return [line for line in told if line[0] == what and line[1] >= since_s]

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

    def start(self, name, command, says=None):
        """Starts a program; waits for a line that begins with what it `says`, and gives the rest."""
        log = open(self.work / f"{name}.log", "a")
        output = subprocess.PIPE if says else log
        running = subprocess.Popen(
            command, cwd=ROOT, env=self.environment, stdin=subprocess.DEVNULL, stdout=output, stderr=log, text=True,
            preexec_fn=be_in_time,
        )
        self.running[name] = running
        line = running.stdout.readline() if says else ""
        assert line.startswith(says or ""), f"{name} did not start:\n{(self.work / f'{name}.log').read_text()}"
        return line.removeprefix(says or "").strip()

    def start_master(self):
        self.start("master", ["/usr/bin/rosmaster", "--core", "-p", str(self.master_port)])

        def answers():
            with socket.socket() as probe:
                return probe.connect_ex(("127.0.0.1", self.master_port)) == 0

        until("the master listens", answers)

    def start_node(self, arm):
        began_s = time.monotonic()
        record = self.records[arm]
        self.start(SIDES[arm], ["env", f"ROS_NAMESPACE=/{SIDES[arm]}", sys.executable, HERE / "arm_node.py", record.path])
        until("the node tells where its arm is", lambda: record.lines("state", began_s))

    def start_relay(self):
        """Starts the relay, again where it was before."""
        command = [sys.executable, HERE / "relay.py", self.relay_port]
        self.relay_port = self.start("relay", command, "listening on ")
        self.arms_at = f"ws://127.0.0.1:{self.relay_port}"

    def start_bridge(self):
        command = [self.tandem_path, "bridge", "--driver", "kinova-ros", "--arms-at", self.arms_at]
        self.address = self.start("bridge", [*command, "--listen", "127.0.0.1:0"], "listening on ")

    def signal(self, name, sent):
        self.running[name].send_signal(sent)

    def kill(self, name):
        """Kills a program without warning; when."""
        at_s = time.monotonic()
        self.signal(name, signal.SIGKILL)
        self.running.pop(name).wait()
        return at_s

    def logs(self):
        """The ends of what the programs said."""
        told = [(name, self.work / f"{name}.log") for name in ("bridge", "relay", *SIDES)]
        return "\n".join(f"{name}:\n{path.read_text()[-2000:]}" for name, path in told if path.exists())

    def end(self):
        for running in self.running.values():
            running.send_signal(signal.SIGCONT)
            running.kill()
            running.wait()

    def command(self, *what):
        return [self.tandem_path, "bridge", *map(str, what), "--connect", self.address]

    def tandem(self, *what):
        return subprocess.run(self.command(*what), cwd=ROOT, capture_output=True, text=True, check=False)

    def spawn(self, *what):
        return subprocess.Popen(
            self.command(*what), cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )

    def status(self):
        told = self.tandem("status", "--json")
        assert told.returncode == 0, told.stderr
        return json.loads(told.stdout)

    def reset(self):
        """Lets the arms go, as soon as they are well, and waits until both nodes are started."""

        def done():
            told = self.tandem("reset")
            assert told.returncode in (0, 75), told.stderr
            return told.returncode == 0 or "not stopped but Idle" in told.stderr

        until("reset", done)
        until("both nodes are started", lambda: all(self.starts()) or self.status()["stopped"])

    def starts(self):
        """Whether the arms were started and not stopped since, arm by arm."""
        for record in self.records:
            told = record.lines("start") + record.lines("stop")
            yield max(told, key=lambda line: line[1])[0] == "start" if told else False

    def unless_busy(self, stopped):
        if stopped and stopped["name"] in BUSY:
            raise Busy(stopped["sentence"])
        assert not stopped, stopped["sentence"]

    def with_arms(self, work):
        """Does `work` with arms that are let go, again as long as a busy machine stops them."""
        for _ in range(8):
            self.reset()
            try:
                return work()
            except Busy as busy:
                print(f"    again, this machine was busy: {busy}", flush=True)
        raise AssertionError("this machine is too busy")

    def moving(self, speed=0.1):
        """A motion that has been under way for a second."""
        began_s = time.monotonic()
        mover = self.spawn("move", "deploy/first-motion.json", "--speed", speed)

        def under_way():
            if mover.poll() is not None:
                self.unless_busy(self.status()["stopped"])
                raise AssertionError(mover.stderr.read())
            return all(
                sum(any(rates) for _, _, _, rates, _, _ in record.lines("state", began_s)) > 100
                for record in self.records
            )

        until("the arms move", under_way)
        return mover

    def rest(self, since_s, arms=(0, 1)):
        """Waits until the arms have stood for a second. For how long they moved since then, seconds, and how far, degrees."""
        records = [self.records[arm] for arm in arms]

        def stands():
            last = [record.lines("state", time.monotonic() - 1.0) for record in records]
            enough = all(len(states) > 20 for states in last)
            return enough and not any(any(state[3]) for states in last for state in states)

        until("the arms stand", stands)
        moved_s, moved_deg = 0.0, 0.0
        for record in records:
            states = record.lines("state", since_s)
            moved_s = max([moved_s] + [at_s - since_s for _, at_s, _, rates, _, _ in states if any(rates)])
            first, last = states[0][2], states[-1][2]
            moved_deg = max([moved_deg] + [abs(a - b) for a, b in zip(first, last)])
        return moved_s, moved_deg

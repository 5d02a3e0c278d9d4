"""The driver kinova-ros over a ROS master, with the built program: check.py TANDEM.

Arms are arm_node.py, rosbridge is relay.py, and the master is ROS' own. What the arms did is read from what their nodes wrote down.
"""

import json
import math
import pathlib
import signal
import sys
import tempfile
import time

from rig import HERE, Rig, until

START_DEG = [-1.5, 110.7, 291.0, 178.5]
FIRST_MOTION = "deploy/first-motion.json"
# How far an arm may go on after whatever moved it was killed or hangs, degrees: what was under way, at a part of its speed.
MOST_DEG = 3.0


def check(so, what):
    assert so, what


def near(got, expected, most, what):
    close = len(got) == len(expected) and all(abs(a - b) <= most for a, b in zip(got, expected))
    check(close, f"{what}: {got}, expected {expected}")


def said(text):
    print(f"    {text}", flush=True)


def arms_are_looked_at(rig):
    """Connecting and looking moves nothing, and what is seen is what the nodes tell."""
    check(rig.status()["stopped"]["name"] == "not-reset", "the arms begin stopped")
    for arm, record in zip(until("states", lambda: rig.status()["arms"]), rig.records):
        near(degrees(arm), START_DEG, 0.01, "angles, degrees")
        near([arm["opening"]], [0.5], 0.001, "opening")
        check(not record.lines("velocity") and not record.lines("start"), "nobody was told to move")
        until("a connection begins with a stop", lambda: record.lines("stop"))


def a_motion_is_played(rig):
    play(rig, FIRST_MOTION, [[-0.12, 0.0, 0.095], [0.12, 0.0, 0.095]])


def grippers_move_while_the_arms_stand(rig):
    play(rig, HERE / "turn-aside.json", [[-0.10, 0.02, 0.12], [0.10, -0.02, 0.12]])
    for record in rig.records:
        until("the gripper is open", lambda: abs(record.last_state()[4] - 640.0) < 64.0)
        said(f"{record.path.stem}: goals of {[round(goal[2]) for goal in record.lines('goal')]} turns")
        near(record.lines("goal")[-1][2:], [640.0, 640.0, 0.0], 64.0, "goal, turns")


def play(rig, file, expected_m):
    def once():
        began_s = time.monotonic()
        moved = rig.tandem("move", file, "--speed", 0.3, "--json")
        if moved.returncode != 0:
            rig.unless_busy(rig.status()["stopped"])
        check(moved.returncode == 0, moved.stderr)
        return began_s, json.loads(moved.stdout)["progress"]

    began_s, progress = rig.with_arms(once)
    ended_s = time.monotonic()
    for arm, at_m, record in zip(progress["arms"], expected_m, rig.records):
        near(arm["tool_in_world_m"], at_m, 0.002, "tool, metres")
        near(degrees(arm), record.last_state()[2], 0.3, "angles, degrees")
        states = record.lines("state", began_s)
        moved_deg = max(abs(state[2][0] - states[0][2][0]) for state in states)
        check(moved_deg > 3.0, f"the arm has moved by {moved_deg} degrees only")
        said(velocities_line(record, states, began_s, ended_s))


def velocities_line(record, states, began_s, ended_s):
    """How regularly velocities came while a motion was played, and how many of them waited in the arm."""
    came_s = [line[1] for line in record.lines("velocity", began_s) if line[1] <= ended_s]
    gaps_ms = sorted(1e3 * (after - before) for before, after in zip(came_s, came_s[1:]))
    mean_ms = sum(gaps_ms) / len(gaps_ms)
    check(abs(mean_ms - 10.0) < 0.5, f"a velocity every {mean_ms} ms")
    waiting = max(state[5] for state in states)
    check(waiting <= 10, f"{waiting} velocities waited in the arm")
    return (
        f"{record.path.stem}: {len(came_s)} velocities, one every {mean_ms:.2f} ms (99 % within "
        f"{gaps_ms[int(0.99 * len(gaps_ms))]:.1f} ms, all within {gaps_ms[-1]:.1f} ms), at most {waiting} waiting in the arm"
    )


def degrees(arm):
    return [math.degrees(angle) for angle in arm["angles_rad"]]


def a_stop_is_heard(rig):
    mover = rig.with_arms(rig.moving)
    at_s = time.monotonic()
    stopped = rig.tandem("stop")
    check(stopped.returncode == 0, stopped.stderr)
    rests(rig, at_s)
    check(all(record.lines("stop", at_s) for record in rig.records), "in/stop is called")
    ends(mover, "a client stopped the arms")


def a_killed_bridge_leaves_arms_at_rest(rig):
    mover = rig.with_arms(lambda: rig.moving(0.5))
    rests(rig, rig.kill("bridge"))
    ends(mover, "the connection to the bridge broke")
    rig.start_bridge()
    check(rig.status()["stopped"]["name"] == "not-reset", "the arms begin stopped")


def a_relay_that_hangs_stops_the_arms(rig):
    mover = rig.with_arms(lambda: rig.moving(0.5))
    at_s = time.monotonic()
    rig.signal("relay", signal.SIGSTOP)
    stopped = until("the arms are stopped", lambda: rig.status()["stopped"])
    rig.signal("relay", signal.SIGCONT)
    rests(rig, at_s)
    if all(record.lines("stop", at_s) for record in rig.records):
        said("in/stop was called when the relay went on")
    ends(mover, stopped["sentence"])


def a_killed_relay_stops_the_arms(rig):
    mover = rig.with_arms(lambda: rig.moving(0.5))
    rests(rig, rig.kill("relay"))
    ends(mover, "the arms are not connected: the connection to rosbridge broke")
    cannot_be_reset(rig, "does rosbridge_websocket run")
    rig.start_relay()
    rig.reset()
    check(rig.status()["phase"] == "idle", "a reset connects again")


def a_killed_node_stops_the_other_arm(rig):
    mover = rig.with_arms(lambda: rig.moving(0.5))
    at_s = rig.kill("left")
    rests(rig, at_s, arms=[1])
    check(rig.records[1].lines("stop", at_s), "in/stop is called")
    ends(mover, "")
    rig.start_node(0)


def a_stranger_stops_the_arms(rig):
    mover = rig.with_arms(rig.moving)
    rig.start("stranger", [sys.executable, HERE / "stranger.py"])
    ends(mover, "another node publishes /left/m1n4s200_driver/in/joint_velocity")
    at_s = rig.kill("stranger")
    rests(rig, at_s)


def arms_do_not_need_the_master_to_stop(rig):
    """Nodes that know one another go on without the master, but no service can be called any more."""
    mover = rig.with_arms(rig.moving)
    at_s = rig.kill("master")
    time.sleep(1.0)
    if rig.status()["stopped"] is None:
        states = [record.lines("state", at_s + 0.5) for record in rig.records]
        check(all(any(state[3]) for told in states for state in told[-3:]), "a motion goes on without the master")
    at_s = time.monotonic()
    stopped = rig.tandem("stop")
    check(stopped.returncode == 0, stopped.stderr)
    rests(rig, at_s)
    check(not any(record.lines("stop", at_s) for record in rig.records), "nobody can call in/stop")
    ends(mover, "the arms are stopped")
    cannot_be_reset(rig, "")


def rests(rig, at_s, arms=(0, 1)):
    moved_s, moved_deg = rig.rest(at_s, arms)
    said(f"the arms stood {1e3 * moved_s:.0f} ms and {moved_deg:.2f} degrees later")
    check(moved_deg < MOST_DEG, "the arms went on")


def ends(mover, expected):
    told = mover.communicate(timeout=60)[1]
    line = told.strip().splitlines()[-1]
    said(f"move: {line}")
    check(mover.returncode == 75 and line.startswith("tandem: ") and expected in line, (mover.returncode, told))


def cannot_be_reset(rig, expected):
    told = rig.tandem("reset")
    said(f"reset: {told.stderr.strip()}")
    check(told.returncode == 75 and expected in told.stderr, (told.returncode, told.stderr))


CASES = [
    arms_are_looked_at,
    a_motion_is_played,
    grippers_move_while_the_arms_stand,
    a_stop_is_heard,
    a_killed_bridge_leaves_arms_at_rest,
    a_relay_that_hangs_stops_the_arms,
    a_killed_relay_stops_the_arms,
    a_killed_node_stops_the_other_arm,
    a_stranger_stops_the_arms,
    arms_do_not_need_the_master_to_stop,
]


def main():
    began_s = time.monotonic()
    with tempfile.TemporaryDirectory() as work:
        rig = Rig(sys.argv[1], pathlib.Path(work))
        try:
            rig.start_master()
            rig.start_node(0)
            rig.start_node(1)
            rig.start_relay()
            rig.start_bridge()
            for case in CASES:
                print(f"- {case.__name__.replace('_', ' ')}", flush=True)
                case(rig)
            print(f"{len(CASES)} cases passed in {time.monotonic() - began_s:.0f} s")
        except BaseException:
            print(rig.logs())
            raise
        finally:
            rig.end()


if __name__ == "__main__":
    main()

"""Tests the driver kinova-ros over a ROS master with the built program: check.py TANDEM.

arm_node.py simulates the arms, relay.py replaces rosbridge, and the master is the real one. The tests read the arms' behavior from the
records of their nodes.
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
# Maximum motion of an arm after the bridge or relay is killed or hangs, degrees: the commands in flight, at reduced speed.
MAX_DRIFT_DEG = 3.0


def check(condition, message):
    assert condition, message


def near(got, expected, tolerance, message):
    close = len(got) == len(expected) and all(abs(a - b) <= tolerance for a, b in zip(got, expected))
    check(close, f"{message}: {got}, expected {expected}")


def report(text):
    print(f"    {text}", flush=True)


def inspecting_the_arms_moves_nothing(rig):
    """Connecting moves nothing, and the status matches the nodes' states."""
    check(rig.status()["stopped"]["name"] == "not-reset", "the arms start stopped")
    for arm, record in zip(until("states", lambda: rig.status()["arms"]), rig.records):
        near(degrees(arm), START_DEG, 0.01, "angles, degrees")
        near([arm["opening"]], [0.5], 0.001, "opening")
        check(not record.lines("velocity") and not record.lines("start"), "no command is sent")
        until("a connection starts with a stop", lambda: record.lines("stop"))


def arms_play_a_motion(rig):
    play(rig, FIRST_MOTION, [[-0.12, 0.0, 0.095], [0.12, 0.0, 0.095]])


def grippers_move_while_the_arms_rest(rig):
    play(rig, HERE / "turn-aside.json", [[-0.10, 0.02, 0.12], [0.10, -0.02, 0.12]])
    for record in rig.records:
        until("the gripper is open", lambda: abs(record.last_state()[4] - 640.0) < 64.0)
        report(f"{record.path.stem}: goals of {[round(goal[2]) for goal in record.lines('goal')]} turns")
        near(record.lines("goal")[-1][2:], [640.0, 640.0, 0.0], 64.0, "goal, turns")
        check(not record.lines("cartesian goal"), "a finger goal with a Cartesian point moves the arm")
        check(all(line[2] < 0.5 for line in record.lines("angles")), "goals of joint angles move the arm")


def play(rig, file, expected_m):
    def once():
        start_s = time.monotonic()
        moved = rig.tandem("move", file, "--speed", 0.3, "--json")
        if moved.returncode != 0:
            rig.unless_busy(rig.status()["stopped"])
        check(moved.returncode == 0, moved.stderr)
        return start_s, json.loads(moved.stdout)["progress"]

    start_s, progress = rig.with_arms(once)
    end_s = time.monotonic()
    for arm, at_m, record in zip(progress["arms"], expected_m, rig.records):
        near(arm["tool_in_world_m"], at_m, 0.002, "tool, metres")
        near(degrees(arm), record.last_state()[2], 0.3, "angles, degrees")
        states = record.lines("state", start_s)
        moved_deg = max(abs(state[2][0] - states[0][2][0]) for state in states)
        check(moved_deg > 3.0, f"the arm moved by only {moved_deg} degrees")
        report(velocity_report(record, states, start_s, end_s))


def velocity_report(record, states, start_s, end_s):
    """Checks and reports the intervals of the velocities during a motion and the length of the arm's queue."""
    received_s = [line[1] for line in record.lines("velocity", start_s) if line[1] <= end_s]
    gaps_ms = sorted(1e3 * (after - before) for before, after in zip(received_s, received_s[1:]))
    mean_ms = sum(gaps_ms) / len(gaps_ms)
    check(abs(mean_ms - 10.0) < 0.5, f"a velocity every {mean_ms} ms")
    waiting = max(state[5] for state in states)
    check(waiting <= 10, f"{waiting} velocities waited in the arm")
    sent = len([line for line in record.lines("sent", start_s) if line[1] <= end_s])
    return (
        f"{record.path.stem}: {len(received_s)} velocities, {100 * sent / len(received_s):.0f} % of them passed on to the arm, one every {mean_ms:.2f} ms (99 % within "
        f"{gaps_ms[int(0.99 * len(gaps_ms))]:.1f} ms, all within {gaps_ms[-1]:.1f} ms), at most {waiting} waiting in the arm"
    )


def degrees(arm):
    return [math.degrees(angle) for angle in arm["angles_rad"]]


def arms_are_homed_one_by_one(rig):
    homing = ["home", "--driver", "kinova-ros", "--arms-at", rig.arms_at, "--yes"]
    homed = rig.alone(*homing)
    check(homed.returncode == 0, homed.stderr)
    times_s = [record.lines("home")[-1][1] for record in rig.records]
    check(times_s[0] + 0.5 < times_s[1], f"homed at {times_s} s")
    for record in rig.records:
        check(record.lines("stop", record.lines("home")[-1][1]), "an arm is stopped after homing")
    rig.reset()
    refused = rig.alone(*homing)
    report(f"home: {refused.stderr.strip().splitlines()[-1]}")
    check(refused.returncode == 75 and "another node publishes" in refused.stderr, refused.stderr)
    check(all(len(record.lines("home")) == 1 for record in rig.records), "arms that a bridge holds are not homed")


def a_node_that_only_reads_its_arm_is_told(rig):
    """With states every 10 ms, the node's thread has no time for velocities."""
    restart_nodes(rig, 0.01, 0.002)

    def once():
        start_s = time.monotonic()
        moved = rig.tandem("move", FIRST_MOTION, "--speed", 0.5)
        stopped = rig.status()["stopped"]
        if stopped and stopped["name"] != "driver":
            rig.unless_busy(stopped)
        check(moved.returncode == 75 and "the node takes too few velocities" in moved.stderr, moved.stderr)
        report(f"move: {moved.stderr.strip().splitlines()[-1]}")
        return start_s

    start_s = rig.with_arms(once)
    for record in rig.records:
        last_s = record.lines("velocity")[-1][1]
        counts = [sum(start_s <= line[1] <= last_s for line in record.lines(what)) for what in ("velocity", "sent", "status")]
        per_s = [count / (last_s - start_s) for count in counts]
        report("{}: {:.0f} velocities, {:.0f} passed on to the arm, {:.0f} states per second".format(record.path.stem, *per_s))
    restart_nodes(rig)


def restart_nodes(rig, *times):
    for arm, side in enumerate(["left", "right"]):
        rig.kill(side)
        rig.start_node(arm, *times)


def a_client_stops_the_arms(rig):
    mover = rig.with_arms(rig.moving)
    at_s = time.monotonic()
    stopped = rig.tandem("stop")
    check(stopped.returncode == 0, stopped.stderr)
    check_rest(rig, at_s)
    check(all(record.lines("stop", at_s) for record in rig.records), "in/stop is called")
    check_end(mover, "a client stopped the arms")


def a_killed_bridge_leaves_arms_at_rest(rig):
    mover = rig.with_arms(lambda: rig.moving(0.5))
    check_rest(rig, rig.kill("bridge"))
    check_end(mover, "the connection to the bridge broke")
    rig.start_bridge()
    check(rig.status()["stopped"]["name"] == "not-reset", "the arms start stopped")


def a_new_bridge_moves_the_grippers_too(rig):
    """The nodes know the goals of the killed bridge, and actionlib ignores a goal whose identifier it knows."""
    play(rig, FIRST_MOTION, [[-0.12, 0.0, 0.095], [0.12, 0.0, 0.095]])
    for record in rig.records:
        until("the gripper is half open", lambda: abs(record.last_state()[4] - 3200.0) < 64.0)


def a_relay_that_hangs_stops_the_arms(rig):
    mover = rig.with_arms(lambda: rig.moving(0.5))
    at_s = time.monotonic()
    rig.signal("relay", signal.SIGSTOP)
    stopped = until("the arms are stopped", lambda: rig.status()["stopped"])
    rig.signal("relay", signal.SIGCONT)
    check_rest(rig, at_s)
    if all(record.lines("stop", at_s) for record in rig.records):
        report("in/stop was called when the relay continued")
    check_end(mover, stopped["sentence"])


def a_killed_relay_stops_the_arms(rig):
    mover = rig.with_arms(lambda: rig.moving(0.5))
    check_rest(rig, rig.kill("relay"))
    check_end(mover, "the arms are not connected: the connection to rosbridge broke")
    check_reset_fails(rig, "does rosbridge_websocket run")
    rig.start_relay()
    rig.reset()
    check(rig.status()["phase"] == "idle", "a reset reconnects")


def a_killed_node_stops_the_other_arm(rig):
    mover = rig.with_arms(lambda: rig.moving(0.5))
    at_s = rig.kill("left")
    check_rest(rig, at_s, arms=[1])
    check(rig.records[1].lines("stop", at_s), "in/stop is called")
    check_end(mover, "")
    rig.start_node(0)


def a_second_publisher_stops_the_arms(rig):
    mover = rig.with_arms(rig.moving)
    rig.start("second-publisher", [sys.executable, HERE / "second_publisher.py"])
    check_end(mover, "another node publishes /left/m1n4s200_driver/in/joint_velocity")
    at_s = rig.kill("second-publisher")
    check_rest(rig, at_s)


def arms_stop_without_the_master(rig):
    """Connected nodes continue without the master, but services can no longer be called."""
    mover = rig.with_arms(rig.moving)
    at_s = rig.kill("master")
    time.sleep(1.0)
    if rig.status()["stopped"] is None:
        states = [record.lines("state", at_s + 0.5) for record in rig.records]
        moving = [sum(any(state[3]) for state in arm_states[-20:]) for arm_states in states]
        check(min(moving) > 10, "a motion continues without the master")
    at_s = time.monotonic()
    stopped = rig.tandem("stop")
    check(stopped.returncode == 75 and "not confirmed" in stopped.stderr, (stopped.returncode, stopped.stderr))
    check_rest(rig, at_s)
    check(not any(record.lines("stop", at_s) for record in rig.records), "in/stop cannot be called")
    check_end(mover, "the arms are stopped")
    check_reset_fails(rig, "")


def check_rest(rig, at_s, arms=(0, 1)):
    moved_s, moved_deg = rig.rest(at_s, arms)
    report(f"the arms came to rest {1e3 * moved_s:.0f} ms and {moved_deg:.2f} degrees later")
    check(moved_deg < MAX_DRIFT_DEG, "the arms drifted too far")


def check_end(mover, expected):
    output = mover.communicate(timeout=60)[1]
    line = output.strip().splitlines()[-1]
    report(f"move: {line}")
    check(mover.returncode == 75 and line.startswith("tandem: ") and expected in line, (mover.returncode, output))


def check_reset_fails(rig, expected):
    output = rig.tandem("reset")
    report(f"reset: {output.stderr.strip()}")
    check(output.returncode == 75 and expected in output.stderr, (output.returncode, output.stderr))


CASES = [
    inspecting_the_arms_moves_nothing,
    arms_are_homed_one_by_one,
    arms_play_a_motion,
    grippers_move_while_the_arms_rest,
    a_client_stops_the_arms,
    a_killed_bridge_leaves_arms_at_rest,
    a_new_bridge_moves_the_grippers_too,
    a_relay_that_hangs_stops_the_arms,
    a_killed_relay_stops_the_arms,
    a_killed_node_stops_the_other_arm,
    a_node_that_only_reads_its_arm_is_told,
    a_second_publisher_stops_the_arms,
    arms_stop_without_the_master,
]


def main():
    start_s = time.monotonic()
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
            print(f"{len(CASES)} cases passed in {time.monotonic() - start_s:.0f} s")
        except BaseException:
            print(rig.logs())
            raise
        finally:
            rig.end()


if __name__ == "__main__":
    main()

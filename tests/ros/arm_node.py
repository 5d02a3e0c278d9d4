"""Simulates the kinova-ros driver node of one arm: arm_node.py RECORD [STATUS_S CALL_S], with ROS_NAMESPACE set.

It provides the topics, services and actions of kinova-ros that the driver uses. As in Kinova's node, one thread serves velocities, services
and the status timer in turn, every call of the arm's interface takes CALL_S under one lock, and a velocity that waits is replaced by a newer
one. As in Kinova's arms, velocities are queued: every 10 ms, one of them moves the joints for 10 ms, and an arm with an empty queue rests.
Queued velocities are always played to the end. There is no noise.

RECORD receives one JSON list per line: an event, its time (seconds of the monotonic clock) and numbers.
"""

import collections
import json
import math
import sys
import threading
import time

import actionlib
import rospy
from kinova_msgs.msg import (
    ArmJointAnglesAction, ArmJointAnglesResult, FingerPosition, JointAngles, JointVelocity, SetFingersPositionAction, SetFingersPositionResult,
)
from kinova_msgs.srv import HomeArm, HomeArmResponse, Start, StartResponse, Stop, StopResponse
from sensor_msgs.msg import JointState

PERIOD_S = 0.01
N_JOINTS = 4
# The start of the simulated pair: the tools are above their workspaces.
START_DEG = [-1.5, 110.7, 291.0, 178.5]
# Finger motor turns: half open, and their speed.
START_TURNS = 3200.0
TURNS_PER_S = 5000.0
# kinova-ros publishes turns as degrees of the finger joints.
DEGREES_PER_TURN = 80.0 / 6800.0
# Capacity of the arm's queue.
MAX_POINTS = 2000
# Duration of in/start and of in/home_arm, during which kinova-ros does nothing else.
START_S = 0.05
HOMING_S = 0.5
# Interval of the status timer and duration of a call of the arm's interface, seconds. Over USB, a status and a velocity are 10 calls, and
# kinova-ros reaches 40 to 60 states per second.
STATUS_S = 0.1
CALL_S = 0.002
NAMES = [f"m1n4s200_joint_{n}" for n in (1, 2, 3, 4)] + [
    f"m1n4s200_joint_finger_{name}" for name in ("1", "2", "tip_1", "tip_2")
]


class Spinner(threading.Thread):
    """The thread that runs all callbacks of a node, in the order in which they are due."""

    def __init__(self, status_s, status):
        super().__init__(daemon=True)
        self.status_s, self.status = status_s, status
        self.changed = threading.Condition()
        self.waiting = collections.deque()

    def add(self, callback):
        with self.changed:
            if callback not in self.waiting:
                self.waiting.append(callback)
                self.changed.notify()

    def call(self, callback):
        """Runs a callback on the thread and returns when it is over."""
        over = threading.Event()

        def run():
            callback()
            over.set()

        self.add(run)
        over.wait()

    def run(self):
        due_s = time.monotonic()
        while True:
            with self.changed:
                while not self.waiting and time.monotonic() < due_s:
                    self.changed.wait(due_s - time.monotonic())
                # As in roscpp, a timer that waits for the thread does not wait twice.
                if time.monotonic() >= due_s and self.status not in self.waiting:
                    self.waiting.append(self.status)
                    due_s = max(due_s + self.status_s, time.monotonic())
                callback = self.waiting.popleft()
            callback()


class Arm:
    def __init__(self, record, status_s, call_s):
        self.record = open(record, "a", buffering=1)
        self.call_s = call_s
        self.interface = threading.RLock()
        self.lock = threading.Lock()
        self.points = collections.deque(maxlen=MAX_POINTS)
        self.angles_deg = list(START_DEG)
        self.rates_degps = [0.0] * N_JOINTS
        self.turns = START_TURNS
        self.goal_turns = None
        self.velocity = None
        self.stopped = False
        self.angular = False
        self.states = rospy.Publisher("~out/joint_state", JointState, queue_size=2)
        self.commands = rospy.Publisher("~out/joint_command", JointAngles, queue_size=2)
        self.spinner = Spinner(status_s, self.publish_status)
        rospy.Subscriber("~in/joint_velocity", JointVelocity, self.receive_velocity)
        rospy.Service("~in/stop", Stop, self.stop)
        rospy.Service("~in/start", Start, self.start)
        rospy.Service("~in/home_arm", HomeArm, self.home)
        self.fingers = self.serve("~fingers_action/finger_positions", SetFingersPositionAction, self.move_fingers)
        self.joints = self.serve("~joints_action/joint_angles", ArmJointAnglesAction, self.move_joints)
        self.spinner.start()

    def serve(self, name, kind, execute):
        server = actionlib.SimpleActionServer(name, kind, execute, auto_start=False)
        server.start()
        return server

    def log(self, what, *numbers):
        self.record.write(json.dumps([what, time.monotonic(), *numbers]) + "\n")

    def call_interface(self, n=1):
        for _ in range(n):
            with self.interface:
                time.sleep(self.call_s)

    def receive_velocity(self, command):
        self.log("velocity")
        self.velocity = [command.joint1, command.joint2, command.joint3, command.joint4]
        self.spinner.add(self.send_velocity)

    def send_velocity(self):
        rates = self.velocity
        if self.stopped:
            return
        self.call_interface()
        with self.lock:
            self.log("sent", rates)
            self.points.append(rates)

    def stop(self, _request):
        self.spinner.call(self.stop_arm)
        return StopResponse("arm stopped")

    def stop_arm(self):
        self.call_interface(2)
        with self.lock:
            self.stopped, self.goal_turns = True, None
            self.points.clear()
            self.log("stop")

    def start(self, _request):
        self.spinner.call(self.start_arm)
        return StartResponse("arm started")

    def start_arm(self):
        self.call_interface(2)
        time.sleep(START_S)
        with self.lock:
            self.stopped, self.angular = False, False
            self.log("start")

    def home(self, _request):
        self.spinner.call(self.home_arm)
        return HomeArmResponse("KINOVA ARM HAS BEEN RETURNED HOME")

    def home_arm(self):
        """Reports success even if the arm is stopped, as Kinova's node does."""
        if not self.stopped:
            self.log("home")
            time.sleep(HOMING_S)

    def move_joints(self, goal):
        self.call_interface(5)
        target = [goal.angles.joint1, goal.angles.joint2, goal.angles.joint3, goal.angles.joint4]
        with self.lock:
            off_deg = max(abs(a - b) for a, b in zip(target, self.angles_deg))
            self.log("angles", off_deg)
            self.angular = True
            self.points.clear()
        self.joints.set_succeeded(ArmJointAnglesResult(JointAngles(*target, 0.0, 0.0, 0.0)))

    def move_fingers(self, goal):
        """Holds the arm until the fingers reach their goal, because a goal is a point in the same queue."""
        self.call_interface(5)
        with self.lock:
            self.log("goal", goal.fingers.finger1, goal.fingers.finger2, goal.fingers.finger3)
            if not self.angular:
                self.log("cartesian goal")
            self.goal_turns = None if self.stopped else goal.fingers.finger1
        while self.goal_turns is not None and not rospy.is_shutdown():
            time.sleep(0.1)
            self.call_interface()
        fingers = FingerPosition(self.turns, self.turns, 0.0)
        self.fingers.set_succeeded(SetFingersPositionResult(fingers))

    def step(self):
        """Simulates 10 ms of the arm."""
        with self.lock:
            self.rates_degps = [0.0] * N_JOINTS
            if self.goal_turns is not None:
                limit = TURNS_PER_S * PERIOD_S
                self.turns += min(max(self.goal_turns - self.turns, -limit), limit)
                if self.turns == self.goal_turns:
                    self.goal_turns = None
            elif self.points:
                self.rates_degps = self.points.popleft()
            self.angles_deg = [at + PERIOD_S * rate for at, rate in zip(self.angles_deg, self.rates_degps)]
            self.log("state", self.angles_deg, self.rates_degps, self.turns, len(self.points))

    def publish_status(self):
        """Reads fingers, angles, command, rates and torques, publishes them, and reads the tool and the fingers again."""
        self.call_interface(2)
        with self.lock:
            angles_deg, rates_degps, turns = list(self.angles_deg), list(self.rates_degps), self.turns
        state = JointState(name=NAMES)
        state.header.stamp = rospy.Time.now()
        self.call_interface(3)
        finger = math.radians(turns * DEGREES_PER_TURN)
        state.position = [math.radians(angle) for angle in angles_deg] + [finger, finger, 0.0, 0.0]
        state.velocity = [math.radians(rate) for rate in rates_degps] + [0.0] * 4
        # Torques that hold the arm against gravity, as kinova-ros publishes them by default.
        state.effort = [0.0, 9.0, 4.0, 0.0] + [0.0] * 4
        self.commands.publish(JointAngles(*angles_deg, 0.0, 0.0, 0.0))
        self.states.publish(state)
        self.log("status")
        self.call_interface(4)


def main():
    rospy.init_node("m1n4s200_driver", disable_signals=True)
    status_s, call_s = map(float, sys.argv[2:4]) if len(sys.argv) > 2 else (STATUS_S, CALL_S)
    arm = Arm(sys.argv[1], status_s, call_s)
    due_s = time.monotonic()
    while True:
        due_s = max(due_s + PERIOD_S, time.monotonic() - 5 * PERIOD_S)
        time.sleep(max(0.0, due_s - time.monotonic()))
        arm.step()


if __name__ == "__main__":
    main()

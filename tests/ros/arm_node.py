"""Simulates the kinova-ros driver node of one arm: arm_node.py RECORD, with ROS_NAMESPACE set.

It provides the topics, services and finger action of kinova-ros that the driver uses. As in Kinova's arms, velocities are queued: every
10 ms, one of them moves the joints for 10 ms, and an arm with an empty queue rests. Queued velocities are always played to the end. There
is no noise.

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
from kinova_msgs.msg import FingerPosition, JointVelocity, SetFingersPositionAction, SetFingersPositionResult
from kinova_msgs.srv import Start, StartResponse, Stop, StopResponse
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
# Duration of in/start, during which kinova-ros publishes no states.
START_S = 0.05
NAMES = [f"m1n4s200_joint_{n}" for n in (1, 2, 3, 4)] + [
    f"m1n4s200_joint_finger_{name}" for name in ("1", "2", "tip_1", "tip_2")
]


class Arm:
    def __init__(self, record):
        self.record = open(record, "a", buffering=1)
        self.lock = threading.Lock()
        self.points = collections.deque(maxlen=MAX_POINTS)
        self.angles_deg = list(START_DEG)
        self.rates_degps = [0.0] * N_JOINTS
        self.turns = START_TURNS
        self.goal_turns = None
        self.stopped = False
        self.states = rospy.Publisher("~out/joint_state", JointState, queue_size=1)
        rospy.Subscriber("~in/joint_velocity", JointVelocity, self.take_velocity)
        rospy.Service("~in/stop", Stop, self.stop)
        rospy.Service("~in/start", Start, self.start)
        self.fingers = actionlib.SimpleActionServer(
            "~fingers_action/finger_positions", SetFingersPositionAction, self.move_fingers, auto_start=False
        )
        self.fingers.start()

    def log(self, what, *numbers):
        self.record.write(json.dumps([what, time.monotonic(), *numbers]) + "\n")

    def take_velocity(self, command):
        with self.lock:
            rates = [command.joint1, command.joint2, command.joint3, command.joint4]
            self.log("velocity", rates)
            if not self.stopped:
                self.points.append(rates)

    def stop(self, _request):
        with self.lock:
            self.stopped, self.goal_turns = True, None
            self.points.clear()
            self.log("stop")
        return StopResponse("arm stopped")

    def start(self, _request):
        with self.lock:
            time.sleep(START_S)
            self.stopped = False
            self.log("start")
        return StartResponse("arm started")

    def move_fingers(self, goal):
        """Holds the arm until the fingers reach their goal, because a goal is a point in the same queue."""
        with self.lock:
            self.log("goal", goal.fingers.finger1, goal.fingers.finger2, goal.fingers.finger3)
            self.goal_turns = None if self.stopped else goal.fingers.finger1
        while self.goal_turns is not None and not rospy.is_shutdown():
            time.sleep(PERIOD_S)
        fingers = FingerPosition(self.turns, self.turns, 0.0)
        self.fingers.set_succeeded(SetFingersPositionResult(fingers))

    def step(self):
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
            self.publish_state()

    def publish_state(self):
        state = JointState(name=NAMES)
        state.header.stamp = rospy.Time.now()
        finger = math.radians(self.turns * DEGREES_PER_TURN)
        state.position = [math.radians(angle) for angle in self.angles_deg] + [finger, finger, 0.0, 0.0]
        state.velocity = [math.radians(rate) for rate in self.rates_degps] + [0.0] * 4
        # Torques that hold the arm against gravity, as kinova-ros publishes them by default.
        state.effort = [0.0, 9.0, 4.0, 0.0] + [0.0] * 4
        self.states.publish(state)


def main():
    rospy.init_node("m1n4s200_driver", disable_signals=True)
    arm = Arm(sys.argv[1])
    due_s = time.monotonic()
    while True:
        due_s = max(due_s + PERIOD_S, time.monotonic() - 5 * PERIOD_S)
        time.sleep(max(0.0, due_s - time.monotonic()))
        arm.step()


if __name__ == "__main__":
    main()

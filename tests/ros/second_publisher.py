"""A second publisher of an arm's velocities, which runs until it is killed."""

import rospy
from kinova_msgs.msg import JointVelocity

rospy.init_node("second_publisher", disable_signals=True)
velocities = rospy.Publisher("/left/m1n4s200_driver/in/joint_velocity", JointVelocity, queue_size=1)
while True:
    velocities.publish(JointVelocity(joint1=4.0))
    rospy.sleep(0.1)

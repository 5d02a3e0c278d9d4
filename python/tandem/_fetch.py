"""The mirror symmetry of Gymnasium-Robotics' Fetch environments."""

from __future__ import annotations

from tandem._task import Reflection

FETCH_REFLECTION = Reflection(
    # y of the distance between hand and object; x and z of the object's rotation and angular velocity; y of velocities.
    observation=(7, 11, 13, 15, 17, 19, 21),
    # y of hand and object.
    position=(1, 4),
    goal=(1,),
    action=(1,),
    # Displacements and velocities of the two fingers.
    moved=((9, 10), (10, 9), (23, 24), (24, 23)),
    plane=0.7491,
)
"""The mirror symmetry of `FetchPush-v4` and `FetchPickAndPlace-v4`, about the plane through the robot's hand at rest."""

"""The digests of 1,000 steps of the shipped students, which the browser demo computes as well."""

import hashlib
import json

import gymnasium
import pytest
from conftest import ROOT

import tandem

DIGESTS = json.loads((ROOT / "demo/digests.json").read_text())


def shipped_name(task):
    """The name of a task in the names of shipped policies."""
    if task in ("push", "pick-and-place"):
        return f"{task}-classic"
    return task.removeprefix("shared-")


@pytest.mark.parametrize("task", DIGESTS)
def test_a_thousand_steps_have_the_bits_of_every_processor(task):
    policy = tandem.load_policy(ROOT / "policies" / f"student-{shipped_name(task)}.safetensors")
    env = gymnasium.make(policy.env_id)
    digest = hashlib.sha256()
    for episode in range(20):
        observation, _ = env.reset(seed=1, options={"episode": episode})
        digest.update(observation["observation"].tobytes())
        for _ in range(50):
            action, _ = policy.predict(observation)
            observation, *_ = env.step(action)
            digest.update(observation["observation"].tobytes())
    assert digest.hexdigest() == DIGESTS[task]

"""Paths of the repository and what several tests need."""

import os
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
POLICIES = sorted((ROOT / "policies").glob("*.safetensors"))
ENV_IDS = [
    "tandem/Push-v0",
    "tandem/PickAndPlace-v0",
    "tandem/TwoArmPush-v0",
    "tandem/TwoArmPickAndPlace-v0",
    "tandem/SharedPush-v0",
    "tandem/SharedPickAndPlace-v0",
    "tandem/SharedTwoArmPush-v0",
    "tandem/SharedTwoArmPickAndPlace-v0",
    "tandem/CarryBar-v0",
]


@pytest.fixture
def rng():
    return np.random.default_rng(1)


@pytest.fixture(scope="session")
def observe_program():
    """The example program `observe`, which executes actions in the Rust environment."""
    path = os.environ.get("TANDEM_OBSERVE")
    if path is None:
        pytest.skip("TANDEM_OBSERVE names no program: cargo build --release --example observe")
    return path

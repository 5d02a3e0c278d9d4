#!/usr/bin/env python3
"""Computes two DDPG updates of tiny networks in double precision, with numpy alone, for the update's tests.

    python3 scripts/ddpg_reference.py > rl/tests/data/ddpg_reference.json

Written from the formulas, not from the program: forward and backward passes as matrix algebra, per-arm heads, behaviour cloning,
action penalty, Adam, Polyak averaging. Each update starts from parameters rounded to float32, so that a test can compare update by
update, without rounding errors that add up.
"""

import json

import numpy as np

N_INPUT, N_ACTION, N_HEADS = 31, 3, 2  # one arm, push; two heads whatever the layout
N_HIDDEN, N_HIDDEN_LAYERS, BATCH = 5, 2, 6
DISCOUNT, ACTION_PENALTY, BC_WEIGHT, POLYAK_KEEP = 0.9, 0.7, 1.5, 0.8
RATES = {"actor": 0.002, "critic": 0.003}
KINK_MARGIN = 1e-4


def to_f32(x):
    return x.astype(np.float32).astype(np.float64)


def shapes(n_in, n_out):
    sizes = [n_in] + [N_HIDDEN] * N_HIDDEN_LAYERS + [n_out]
    return list(zip(sizes[1:], sizes[:-1]))


SHAPES = {"actor": shapes(N_INPUT, N_ACTION), "critic": shapes(N_INPUT + N_ACTION, N_HEADS)}


def unflatten(name, flat):
    layers, at = [], 0
    for n_out, n_in in SHAPES[name]:
        weight = flat[at : at + n_out * n_in].reshape(n_out, n_in)
        at += n_out * n_in
        layers.append((weight, flat[at : at + n_out]))
        at += n_out
    assert at == len(flat)
    return layers


def forward(layers, x):
    """The output and every layer's input."""
    seen = []
    for i, (weight, bias) in enumerate(layers):
        seen.append(x)
        x = x @ weight.T + bias
        if i + 1 < len(layers):
            assert np.abs(x).min() > KINK_MARGIN, "a unit too near its kink: choose another seed"
            x = np.maximum(x, 0)
    return x, seen


def backward(layers, seen, d_out):
    """Gradients by the flat parameters and by the input."""
    parts = []
    for i in reversed(range(len(layers))):
        weight, _ = layers[i]
        parts = [(d_out.T @ seen[i]).ravel(), d_out.sum(0)] + parts
        d_out = d_out @ weight
        if i > 0:
            d_out = d_out * (seen[i] > 0)
    return np.concatenate(parts), d_out


def gradients(state, batch, clamped):
    b = len(batch["inputs"])
    net = {key: unflatten(key.split(".")[0], state[key]) for key in state if "adam" not in key}

    next_action = np.tanh(forward(net["actor.target"], batch["next_inputs"])[0])
    next_q, _ = forward(net["critic.target"], np.hstack([batch["next_inputs"], next_action]))
    raw = batch["rewards"] + DISCOUNT * next_q
    target = np.clip(raw, -1 / (1 - DISCOUNT), 0)
    clamped.update({"low": clamped["low"] or bool((raw < target).any()), "high": clamped["high"] or bool((raw > target).any())})
    q, seen = forward(net["critic.online"], np.hstack([batch["inputs"], batch["actions"]]))
    critic_loss = ((q - target) ** 2).sum() / b
    critic_gradient, _ = backward(net["critic.online"], seen, 2 * (q - target) / b)

    raw_action, actor_seen = forward(net["actor.online"], batch["inputs"])
    action = np.tanh(raw_action)
    q, seen = forward(net["critic.online"], np.hstack([batch["inputs"], action]))
    error = batch["bc_mask"] * (action - batch["actions"])
    actor_loss = -q.sum() / b + ACTION_PENALTY * (action**2).mean() + BC_WEIGHT * (error**2).sum() / b
    _, d_input = backward(net["critic.online"], seen, np.full_like(q, -1 / b))
    d_action = d_input[:, N_INPUT:] + 2 * ACTION_PENALTY * action / action.size + 2 * BC_WEIGHT * error / b
    actor_gradient, _ = backward(net["actor.online"], actor_seen, d_action * (1 - action**2))
    losses = {"critic_loss": critic_loss, "actor_loss": actor_loss, "mean_q": q.mean()}
    return losses, {"actor": actor_gradient, "critic": critic_gradient}


def step(state, gradient, t):
    new = {}
    for name, g in gradient.items():
        first = 0.9 * state[f"{name}.adam.first"] + 0.1 * g
        second = 0.999 * state[f"{name}.adam.second"] + 0.001 * g**2
        move = (first / (1 - 0.9**t)) / (np.sqrt(second / (1 - 0.999**t)) + 1e-8)
        online = state[f"{name}.online"] - RATES[name] * move
        target = POLYAK_KEEP * state[f"{name}.target"] + (1 - POLYAK_KEEP) * online
        new |= {f"{name}.online": online, f"{name}.target": target}
        new |= {f"{name}.adam.first": first, f"{name}.adam.second": second}
    return new


def main(seed):
    rng = np.random.default_rng(seed)
    decimals = lambda shape, scale: to_f32(np.round(rng.uniform(-scale, scale, shape), 3))
    state = {}
    for name, layers in SHAPES.items():
        n = sum(n_out * (n_in + 1) for n_out, n_in in layers)
        state |= {f"{name}.online": decimals(n, 0.5), f"{name}.target": decimals(n, 0.5)}
        state |= {f"{name}.adam.first": np.zeros(n), f"{name}.adam.second": np.zeros(n)}
    state["critic.target"][-N_HEADS:] = [-11.0, 0.2]  # so that targets are clipped at both ends

    clamped = {"low": False, "high": False}
    updates = []
    for t in (1, 2):
        batch = {"inputs": decimals((BATCH, N_INPUT), 1), "next_inputs": decimals((BATCH, N_INPUT), 1)}
        batch["actions"] = decimals((BATCH, N_ACTION), 1)
        batch["rewards"] = rng.integers(-1, 1, (BATCH, N_HEADS)).astype(float)
        batch["bc_mask"] = (rng.uniform(size=(BATCH, 1)) < 0.5) * np.ones((1, N_ACTION))
        losses, gradient = gradients(state, batch, clamped)
        after = step(state, gradient, t)
        updates.append({"before": state, "batch": batch, "losses": losses, "gradient": gradient, "after": after})
        state = {key: to_f32(value) for key, value in after.items()}
    assert all(clamped.values()), clamped
    config = {"discount": DISCOUNT, "action_penalty": ACTION_PENALTY, "bc_weight": BC_WEIGHT}
    config |= {"polyak_keep": POLYAK_KEEP, "batch_size": BATCH, "n_hidden": N_HIDDEN, "n_hidden_layers": N_HIDDEN_LAYERS}
    config |= {f"{name}_learning_rate": rate for name, rate in RATES.items()}
    flat = lambda x: [float(f"{v:.9g}") for v in x.ravel()] if isinstance(x, np.ndarray) else float(x)
    nested = lambda x: {k: nested(v) for k, v in x.items()} if isinstance(x, dict) else flat(x)
    print(json.dumps({"config": config, "updates": [nested(update) for update in updates]}))


if __name__ == "__main__":
    main(seed=8)

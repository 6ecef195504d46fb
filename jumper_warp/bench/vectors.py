"""Conformance vectors of a policy: 500 policy steps in simulation, as npz for a bundle and as JSON for a browser.

Observations, actions and filtered targets are those of the environment that evaluates policies and of the PyTorch
network. Readings are the newest frames of the observations.
"""

from __future__ import annotations

import io

import numpy as np

from jumper_warp.deploy.codec import Codec, Reply
from jumper_warp.evaluation.conditions import Conditions, env_of_recipe
from jumper_warp.policies.policy import Policy
from jumper_warp.robot.description import load_description
from jumper_warp.sim.simulation import motor_values
from jumper_warp.utils.assets import ASSETS

STEPS, EPISODES = 500, 4
OBSERVATION_EVERY = 10  # policy steps between two recorded observations
FRAMES = 40  # policy steps with the motors' frames
COMMAND_STEP = 30.0  # policy step of the command to jump
COMMANDS = {
    "wanted_height": ([0.0, 0.0, 0.6], [0.0, 0.0, 0.75], [0.0, 0.0, 0.9], [0.0, 0.0, 1.0]),
    "goal": ([0.8, 0.2, 0.0], [1.2, 0.0, 0.0], [0.3, -0.3, 0.0], [-0.3, 0.1, 0.0]),
    "command": ([0.5, 0.0, 0.0], [0.3, 0.2, 0.5], [-0.3, 0.0, -0.5], [0.8, -0.1, 0.2]),
}
"""Commands of the episodes by observation term of the command."""


def record_vectors(policy: Policy, episodes: int = EPISODES, steps: int = STEPS) -> dict[str, np.ndarray]:
    """Return the vectors of a policy: arrays by name, with a row a policy step; see docs/reference/bundle.md."""
    layout = policy.interface.observation_layout
    term = next(name for name in COMMANDS if name in layout)
    env = env_of_recipe(policy.recipe(), 1, Conditions(device="cpu"))
    names = [name for name in layout if name != "last_action"]
    rows: dict[str, list] = {name: [] for name in ("observation", "action", "target", "reset", "angle", "rate")}
    rows |= {f"reading_{name}": [] for name in names}
    for step in range(steps):
        episode, within = divmod(step, steps // episodes)
        if within == 0 and episode < episodes:
            at = [] if term == "command" else [COMMAND_STEP]
            env.evaluation_reset([COMMANDS[term][episode] + at], 0.5)
        obs = env.obs.clone()
        action = policy.act(obs)
        angle = motor_values(env.sim.joint_q()[0, 7:]).copy()
        rate = motor_values(env.sim.joint_qd()[0, 6:]).copy()
        for name in names:
            width = (layout[name]["end"] - layout[name]["first"]) // layout[name]["history"]
            frame = obs[0, layout[name]["end"] - width : layout[name]["end"]].numpy() / layout[name]["scale"]
            rows[f"reading_{name}"].append({"angle": angle, "rate": rate}.get(name, frame))
        env.step(action)
        target = env.robot.filtered_target.numpy()[:, 0].copy()
        values = (obs[0].numpy(), action[0].numpy(), target, within == 0 and episode < episodes, angle, rate)
        for name, value in zip(rows, values, strict=False):
            rows[name].append(value)
    arrays = {name: np.array(values) for name, values in rows.items()}
    vectors = _frames(arrays, policy)
    arrays["observation"] = arrays["observation"][::OBSERVATION_EVERY]
    names = [f"reading_{name}" for name in names] + ["observation", "action", "target"]
    vectors |= {name: arrays[name].astype(np.float32) for name in names}
    return vectors | {"reset": arrays["reset"], "observation_every": np.array(OBSERVATION_EVERY)}


def _frames(arrays: dict[str, np.ndarray], policy: Policy) -> dict[str, np.ndarray]:
    """Return the motors' frames of the first policy steps, gains, and names; motor 3 · leg + j is joint 3 · leg + j."""
    motors = [motor.type for motor in load_description().motors]
    codec, zero = Codec(motors), np.zeros(12)
    spec = policy.interface
    gains = np.array([spec.joint_stiffness, spec.joint_damping, spec.torque_limit])
    replies, commands = [], []
    for angle, rate, target in zip(*(arrays[name][:FRAMES] for name in ("angle", "rate", "target")), strict=True):
        reply = Reply(angle, rate, zero, zero + 35.0, zero.astype(int))
        replies.append(codec.encode_reply(np.tile([1, 2, 3], 4), reply))
        commands.append(codec.encode(np.array([target, zero, *gains[:2], zero])))
    decoded = [codec.decode_reply(frames) for frames in replies]
    return {
        "motors": np.array(motors), "joint_names": np.array(spec.joint_names), "gains": gains.astype(np.float32),
        "replies": np.array(replies), "commands": np.array(commands),
        "reply_angle": np.array([each.position for each in decoded], dtype=np.float32),
        "reply_rate": np.array([each.velocity for each in decoded], dtype=np.float32),
    }  # fmt: skip


def vectors_bytes(name: str, policy: Policy) -> bytes:
    """Return the vectors of a policy as an npz file: those of the project's policy of this name, else recorded ones."""
    shipped = ASSETS / "conformance" / f"{name}.npz"
    if shipped.is_file():
        return shipped.read_bytes()
    file = io.BytesIO()
    np.savez_compressed(file, allow_pickle=False, **record_vectors(policy))
    return file.getvalue()

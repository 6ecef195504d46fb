"""Conformance of a bundle: recorded readings, frames, observations, actions and targets against those of the runtime.

The vectors of a policy are recorded in simulation, by code that shares nothing with the bundle's settings. A wrong
order or sign of joints, degrees in place of radians, or a wrong history differ from them.
"""

from __future__ import annotations

import numpy as np

from jumper_warp.deploy.bundle import Bundle
from jumper_warp.deploy.bus import Link
from jumper_warp.deploy.codec import Codec
from jumper_warp.deploy.runtime import Runtime
from jumper_warp.utils.errors import InputError

TOLERANCE = 1.0e-5  # of observations and actions; rounding of the network's sums


def check_bundle(bundle: Bundle) -> list[str]:
    """Return a line for each difference between a bundle and its vectors; an empty list: it conforms.

    Raises InputError: a setting is missing or of a wrong type.
    """
    differences = []
    with bundle.reading():
        Runtime(bundle, Link([]))  # reads the other settings
        for name in bundle.policies:
            with np.load(bundle.file(f"{name}.npz"), allow_pickle=False) as file:
                vectors = {key: file[key] for key in file.files}
            differences += [f"{name}: {line}" for line in _check_policy(bundle, name, vectors)]
    return differences


def _check_policy(bundle: Bundle, name: str, vectors: dict[str, np.ndarray]) -> list[str]:
    """Return a line for each kind of value in which a policy differs from its vectors."""
    policy, joints = bundle.policies[name], bundle.joints
    worst: dict[str, float] = {}

    def compare(kind: str, ours: np.ndarray, expected: np.ndarray) -> None:
        """Keep the largest difference of a kind of value."""
        error = np.abs(np.asarray(ours, dtype=float) - expected).max() if ours.shape == expected.shape else np.inf
        worst[kind] = max(worst.get(kind, 0.0), float(error))

    fields = bundle.settings["policies"][name]
    gains = np.array([fields["stiffness"], fields["damping"], fields["torque_limit"]], dtype=np.float32)
    compare("gains", gains, vectors["gains"])
    for step in range(len(vectors["action"])):
        if vectors["reset"][step]:
            policy.reset()
        readings = {key[8:]: vectors[key][step] for key in vectors if key.startswith("reading_")}
        if step < len(vectors["replies"]):
            angle, rate = joints.read(vectors["replies"][step])[:2]
            compare("angles in replies [rad]", angle, vectors["reply_angle"][step])
            compare("rates in replies [rad/s]", rate, vectors["reply_rate"][step])
            ours = joints.codec.decode_command(joints.frames(vectors["target"][step], gains[0], gains[1]))
            expected = Codec(vectors["motors"].tolist()).decode_command(vectors["commands"][step])
            compare("command frames", ours, expected)
        try:
            observation = policy.observe(readings)
            action = policy.act(observation)
        except InputError as error:
            return [f"step {step}: {error}"]
        if step % int(vectors["observation_every"]) == 0:
            compare("observation", observation, vectors["observation"][step // int(vectors["observation_every"])])
        compare("action", action, vectors["action"][step])
        policy.action = vectors["action"][step]  # so that rounding does not accumulate
        target = policy.default + policy.scale * vectors["action"][step]
        filtered = policy.filter_targets(target, readings["angle"], readings["rate"])
        compare("filtered target [rad]", filtered, vectors["target"][step])
    policy.reset()
    return [f"{kind} differ by up to {error:.3g}" for kind, error in worst.items() if not error <= TOLERANCE]

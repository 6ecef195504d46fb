"""Damaged checkpoints, also with valid checksums: each is resumed, or refused with a one-line error."""

import copy
import hashlib
import json

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from jump_helpers import make_env
from jumper_warp.policies.runs import open_policy
from jumper_warp.policies.spec import PolicyError
from jumper_warp.rl.cfg import PpoCfg, TrainCfg
from jumper_warp.rl.checkpoint import MANIFEST, CheckpointError, load_checkpoint
from jumper_warp.rl.distributed import Rank
from jumper_warp.rl.runner import CHECKPOINTS, TrainingRun, train

PPO = PpoCfg(num_steps=4, hidden=(8, 4), minibatches=2, epochs=1)
SINGLE_RANK = Rank(0, 1, torch.device("cpu"))
REMOVED = float("nan")
"""Returned by a function in CHANGES to remove the part (compared by identity)."""


class Saved:
    """Checkpoint of a short training with its environment; damaged copies replace its file."""

    def __init__(self, folder):
        """Train for one iteration; folder: for the run."""
        self.env = make_env(2, seed=1, randomize=True, noise=True)
        self.cfg = TrainCfg(
            task="jump", num_envs=2, max_iterations=1, device="cpu", log_root=folder, tensorboard=False, ppo=PPO
        )
        self.path = train(self.cfg, lambda *_: self.env).folder / CHECKPOINTS / "iteration_000001.pt"
        self.data, self.state = self.path.read_bytes(), load_checkpoint(self.path)

    def sign(self, data):
        """Write bytes as the checkpoint's file, with a valid checksum."""
        self.path.write_bytes(data)
        manifest = json.loads((self.path.parent / MANIFEST).read_text())
        manifest[self.path.name]["sha256"] = hashlib.sha256(data).hexdigest()
        (self.path.parent / MANIFEST).write_text(json.dumps(manifest))

    def resume(self):
        """Resume the run and train for one iteration; return the message of a CheckpointError, or None."""
        cfg = TrainCfg(**{**vars(self.cfg), "max_iterations": 100, "resume": str(self.path)})
        try:
            run = TrainingRun(cfg, self.env, SINGLE_RANK)
        except CheckpointError as error:
            return str(error)
        run.ppo.collect()
        run.ppo.update()
        return None

    def save(self, state):
        """Write a state as the checkpoint, with a valid checksum."""
        torch.save(state, self.path)
        self.sign(self.path.read_bytes())


@pytest.fixture(scope="module")
def saved(tmp_path_factory, one_thread):
    """`Saved` of a run on one thread."""
    return Saved(tmp_path_factory.mktemp("run"))


def part_paths(state, start=()):
    """Return the tuple of keys to each part of nested dictionaries and lists; start: keys to `state` itself."""
    keys = state.keys() if isinstance(state, dict) else range(len(state)) if isinstance(state, list) else ()
    here = [(*start, key) for key in keys]
    return here + [part_path for path in here for part_path in part_paths(state[path[-1]], path)]


def changed(state, part_path, change):
    """Return a copy of a state with `change` applied to the part at `part_path`; REMOVED removes it."""
    state = part = copy.deepcopy(state)
    for key in part_path[:-1]:
        part = part[key]
    new = change(part[part_path[-1]])
    if new is REMOVED:
        del part[part_path[-1]]
    else:
        part[part_path[-1]] = new
    return state


def of_tensor(change):
    """Return a function that applies `change` to a copy of a tensor; other values count as torch.zeros(3)."""
    return lambda value: change(value.clone()) if isinstance(value, torch.Tensor) else change(torch.zeros(3))


def negated(x):
    """Return -x, or the inverse of a bool tensor."""
    return ~x if x.dtype == torch.bool else -x


JUNK = [None, True, -1, 2**70, 1.5, float("inf"), "late", "", b"\0", [], {}, [1], {"a": 1}, {3: {}}, torch.zeros(0)]
CHANGES = {
    "removed": lambda value: REMOVED,
    **{f"{junk!r}": (lambda value, junk=junk: junk) for junk in JUNK},
    "nan": of_tensor(lambda x: torch.full_like(x, float("nan")) if x.is_floating_point() else negated(x)),
    "infinite": of_tensor(lambda x: x + float("inf") if x.is_floating_point() else x + 100),
    "negative": of_tensor(lambda x: negated(x.double().abs().sub(-1.0).to(x.dtype))),
    "flat": of_tensor(lambda x: x.flatten()),
    "one less": of_tensor(lambda x: x.flatten()[:-1]),
    "one more axis": of_tensor(lambda x: x[None]),
    "double": of_tensor(lambda x: x.double()),
    "half": of_tensor(lambda x: x.half()),
    "whole": of_tensor(lambda x: torch.nan_to_num(x).long()),
    "complex": of_tensor(lambda x: x.to(torch.complex64)),
    "sparse": of_tensor(lambda x: x.float().to_sparse()),
    "extra key": lambda value: {**value, "extra": 1} if isinstance(value, dict) else {"extra": value},
}
"""Functions of a part that return its replacement, by name."""


def is_refusal(message, path):
    """Return whether a message is one line that begins with the path, and at most 400 characters longer."""
    return "\n" not in message and message.startswith(f"{path}: ") and len(message) < len(str(path)) + 400


@settings(max_examples=120, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_changed_part_is_resumed_or_refused_in_one_line(saved, data):
    part_path = data.draw(st.sampled_from(part_paths(saved.state)))
    change = CHANGES[data.draw(st.sampled_from(sorted(CHANGES)))]
    saved.save(changed(saved.state, part_path, change))
    message = saved.resume()
    assert message is None or is_refusal(message, saved.path)


@settings(max_examples=40, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_changed_bytes_with_valid_checksum_are_resumed_or_refused_in_one_line(saved, data):
    content = bytearray(saved.data)
    if data.draw(st.booleans()):
        del content[data.draw(st.integers(0, len(content))) :]
    else:
        for at in data.draw(st.lists(st.integers(0, len(content) - 1), min_size=1, max_size=40)):
            content[at] = data.draw(st.integers(0, 255))
    saved.sign(bytes(content))
    message = saved.resume()
    assert message is None or is_refusal(message, saved.path)


@pytest.mark.filterwarnings("ignore:Casting complex")
@settings(max_examples=30, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_policy_of_a_changed_checkpoint_is_opened_or_refused_in_one_line(saved, data):
    paths = part_paths(saved.state)
    read = [path for path in paths if path[0] in ("iteration", "config") or "model" in path]  # parts of the policy
    change = CHANGES[data.draw(st.sampled_from(sorted(CHANGES)))]
    saved.save(changed(saved.state, data.draw(st.sampled_from(read)), change))
    try:
        open_policy(saved.path)
    except (CheckpointError, PolicyError) as error:
        assert is_refusal(str(error), saved.path)


def test_unchanged_checkpoint_is_resumed(saved):
    saved.sign(saved.data)
    assert saved.resume() is None


INVALID_PARTS = [  # keys to a part, its new value, and the error message
    (("iteration",), "late", "iteration must be int, got str"),
    (("iteration",), 7, "iteration is 7, in manifest.json 1"),
    (("rng", "cpu"), REMOVED, "rng lacks cpu"),
    (("rng", "cpu"), torch.zeros(5), "rng.cpu has shape (5,), expected (5056,)"),
    (("rng", "cpu"), torch.zeros(5056, dtype=torch.uint8), "rng is not the state of a generator"),
    (("ppo",), [], "ppo must be dict, got list"),
    (("ppo", "optimiser"), {}, "ppo.optimiser: missing entries: 0, 1, 10 and 10 more; unexpected entries: none"),
    (("ppo", "optimiser", 0, "step"), REMOVED, "ppo.optimiser.0: missing entries: step; unexpected entries: none"),
    (("ppo", "optimiser", 0, "exp_avg"), torch.zeros(2), "ppo.optimiser.0.exp_avg has shape (2,), expected (8, 147)"),
    (("ppo", "optimiser", 1, "exp_avg_sq"), torch.full((8,), -1.0), "ppo.optimiser.1.exp_avg_sq must not be below 0"),
    (("ppo", "model", "actor.0.bias"), torch.full((8,), float("nan")), "ppo.model.actor.0.bias is not finite"),
    (("ppo", "model", "log_std"), "x", "ppo.model.log_std must be a tensor, got str"),
    (("ppo", "model", "critic.0.bias"), torch.zeros(8).long(), "ppo.model.critic.0.bias has type torch.int64"),
    (("ppo", "model", "value_moments.var"), torch.tensor(-1.0).double(), "value_moments.var must not be below 0, got"),
    (("ppo", "lr"), torch.tensor(float("inf")), "ppo.lr is not finite"),
    (("ppo", "episode"), torch.zeros(3), "ppo.episode has shape (3,), expected (2, 2)"),
    (("env", "vertical-jump/now"), None, "saved vertical-jump/now must be a tensor, got NoneType"),
    (("env", "robot.joint_q"), torch.zeros(3), "saved robot.joint_q has shape (3,), expected (86,)"),
    (("env", "vertical-jump.goal"), torch.zeros(2, 3).double(), "saved vertical-jump.goal has type torch.float64"),
    (("env", "env.level"), torch.tensor([0, -1], dtype=torch.int32), "saved env.level must not be below 0"),
    (("others",), 3, "others must be a list, got int"),
    (("seconds",), float("nan"), "seconds must be a number, finite and not negative, got nan"),
]


@pytest.mark.parametrize(("part_path", "value", "message"), INVALID_PARTS)
def test_error_message_names_the_invalid_part(saved, part_path, value, message):
    saved.save(changed(saved.state, part_path, lambda _: value))
    message = saved.resume()
    assert message is not None and message in message and is_refusal(message, saved.path)


def test_refuses_an_empty_file_with_valid_checksum(saved):
    saved.sign(b"")
    assert "not readable as tensors: " in saved.resume()


def test_error_message_names_missing_parts_of_another_rank(saved):
    rank_1 = {"ppo": {"episode": saved.state["ppo"]["episode"]}, "env": saved.state["env"]}
    saved.save({**saved.state, "others": [rank_1]})
    cfg = TrainCfg(**{**vars(saved.cfg), "resume": str(saved.path)})
    with pytest.raises(CheckpointError, match=r"others\.0: missing entries: rng; unexpected entries: none"):
        TrainingRun(cfg, saved.env, Rank(1, 2, torch.device("cpu")))

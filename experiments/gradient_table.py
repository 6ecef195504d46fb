"""Compare gradients through legged contact: SolverJumper, MuJoCo, MJX and Newton's solvers; write metrics.

    python experiments/gradient_table.py --out outputs/gradient_table
    pip install --target FOLDER "jax[cpu]" mujoco-mjx==3.17.0 mujoco==3.17.0
    PYTHONPATH=FOLDER python experiments/gradient_table.py --rivals mjx mjx_8_iterations

Jumper stands in its default pose, is held there by its motors for 72 physics steps of 1/480 s, and pushes off. The
scalar is base height plus 0.1 s times vertical base velocity after a number of physics steps; the gradient is by
constant offsets of the 12 motor targets. One world on a CPU. Each gradient is compared with central differences of the
same simulation, whose step is swept over decades: of all neighbouring steps, the pair with the smallest change gives
the reference (its smaller step) and the reference's own uncertainty. Cost is processor time relative to the forward
run. A simulation whose package is missing, or that diverges, is skipped with one line:

- ours, ours_single: `Rollout` in double precision, and in single precision against differences in double precision.
- mujoco: central differences of whole rollouts of MuJoCo C, with a step that is chosen in advance.
- mjx: MJX in double precision with one solver iteration; its loop over more iterations has no reverse mode.
  mjx_8_iterations: this loop replaced by MJX's own scan. Both need jax and mujoco-mjx; compilation takes minutes.
- newton_mujoco, newton_semi_implicit, newton_featherstone, newton_featherstone_fresh: Warp's tape through Newton's
  solvers, in single precision. The semi-implicit solver takes 50 steps in 1/480 s and closes the loops by springs.
  Featherstone's takes 8 and has no loops: the passive knees have motors instead. fresh: a new solver for each step.
"""

from __future__ import annotations

import dataclasses
import importlib.metadata
import itertools
import time
import timeit
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from jumper_warp.diff.rollout import Rollout, Trajectory
from jumper_warp.robot.description import load_description
from jumper_warp.robot.model import KNEE_DOFS, MOTOR_DOFS, PHYSICS_DT, build_model, standing_configuration
from jumper_warp.utils.assets import ASSETS
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.output import output_dir
from support.scripts import OutputArgs, announce, report, run_script

mujoco: Any = import_module("mujoco")
HOLD = 72  # Number of physics steps in the default pose
PUSH = 0.2  # [rad] Transversal angles of the push-off
SINK = 1.0e-4  # [m] Depth of the paws in the ground at the start
SPEED_WEIGHT = 0.1  # [s] Weight of the vertical velocity in the scalar
OFFSETS = np.random.default_rng(0).uniform(-0.03, 0.03, 12)  # [rad] Offsets at which gradients are taken
DOUBLE_STEPS = 10.0 ** -np.arange(3.0, 9.0)  # [rad] Steps of differences in double precision
SINGLE_STEPS = 10.0 ** -np.arange(1.5, 3.1, 0.5)  # [rad] Steps of differences in single precision
STEP = 3.0e-6  # [rad] Step of MuJoCo's differences as a method, chosen in advance and not among those above
HORIZON = 288  # Number of physics steps for which MJX is compiled
PACKAGES = ("mujoco", "mujoco-mjx", "mujoco-warp", "newton", "warp-lang", "jax")
KINDS = ("mujoco", "semi_implicit", "featherstone", "featherstone_fresh")  # of Newton's solvers
MOTORS = np.array(MOTOR_DOFS) + 1  # Indices of the motors in Newton's joint coordinates


@cache
def pose(pushing: bool) -> np.ndarray:
    """Return Newton's 43 joint coordinates in the default pose, or at the end of the push-off."""
    robot = load_description()
    robot = dataclasses.replace(robot, poses={**robot.poses, "push": (0.0, PUSH)})
    return standing_configuration(robot, "push" if pushing else "default")


def joint_targets(step: int, offsets: np.ndarray | float = 0.0) -> np.ndarray:
    """Return Newton's 43 joint targets of a physics step, with offsets of the motors [rad]."""
    targets = pose(step >= HOLD).copy()
    targets[MOTORS] += offsets
    return targets


class Simulation:
    """Simulation of the push-off, with gradients.

    `scores(offsets, length)` yields the scalar [m] after each physics step; `forward` and `gradient` are what is timed.
    """

    steps = DOUBLE_STEPS
    memory = 0.0  # [byte] per physics step of 1/480 s, after `gradient`
    scores: Callable[[np.ndarray, int], Iterable[float]]
    gradient: Callable[[int], np.ndarray]

    def values(self, offsets: np.ndarray, lengths: tuple[int, ...]) -> np.ndarray:
        """Return the scalars [m] after each length, (n, lengths), for offsets [rad] (n, 12).

        lengths: numbers of physics steps from 1 on, ascending and distinct; columns have their order.
        """
        runs = (enumerate(self.scores(row, max(lengths)), 1) for row in offsets)
        return np.array([[score for step, score in run if step in lengths] for run in runs])

    def forward(self, length: int) -> Any:
        """Simulate once over a number of physics steps."""
        return self.values(OFFSETS[None], (length,))

    def differences(self, step: float, lengths: tuple[int, ...]) -> np.ndarray:
        """Return central differences [m/rad] of the scalars by the offsets, (lengths, 12); step [rad]."""
        moves = step * np.eye(12)
        upper, lower = np.split(self.values(OFFSETS + np.concatenate([moves, -moves]), lengths), 2)
        return (upper - lower).T / (2.0 * step)


class Ours(Simulation):
    """SolverJumper's rollout."""

    def __init__(self, *, double: bool) -> None:
        """Prepare rollouts; double: precision of the gradient, while differences are always in double precision."""
        self._one, self._exact = (
            Rollout(build_model(worlds, visuals=False, device="cpu"), double=precise, threads=1)
            for worlds, precise in ((1, double), (24, True))
        )

    def _run(self, rollout: Rollout, offsets: np.ndarray, length: int) -> Trajectory:
        """Return the trajectory with offsets (worlds, 12)."""
        q, qd = rollout.standing()
        q[2] -= SINK
        base = np.array([joint_targets(step)[MOTORS] for step in range(0, length, rollout.substeps)])
        return rollout.run(base[:, :, None] + offsets.T, q, qd)

    def forward(self, length: int) -> Trajectory:
        """Simulate once, in the precision of the gradient."""
        return self._run(self._one, OFFSETS[None], length)

    def values(self, offsets: np.ndarray, lengths: tuple[int, ...]) -> np.ndarray:
        """Return the scalars [m] of 24 worlds; lengths: as in `Simulation.values`, multiples of `Rollout.substeps`."""
        run = self._run(self._exact, offsets, max(lengths))
        rows = [length // self._exact.substeps for length in lengths]
        return (run.q.numpy()[rows, 2] + SPEED_WEIGHT * run.qd.numpy()[rows, 2]).T

    def gradient(self, length: int) -> np.ndarray:
        """Return the gradient by the reverse pass."""
        run = self.forward(length)
        q, qd = np.zeros(run.q.shape), np.zeros(run.qd.shape)
        q[-1, 2], qd[-1, 2] = 1.0, SPEED_WEIGHT
        saved = (run.q, run.qd, run.torque, run.impulse, run.pressed, run.filtered_target)
        self.memory = sum(array.size * wp.types.type_size_in_bytes(array.dtype) for array in saved) / length
        by_inputs = self._one.backward(run, q=self._one.array(q), qd=self._one.array(qd))
        return by_inputs["targets"].numpy().sum(axis=(0, 2))


def load_mjcf() -> tuple[Any, Any]:
    """Return the exported robot, without its meshes, and its data at the start, which is keyframe 0."""
    spec = mujoco.MjSpec.from_file(str(ASSETS / "jumper" / "jumper.xml"))
    spec.compiler.discardvisual = True
    model = spec.compile()
    model.opt.tolerance = 1.0e-12
    model.key_qpos[0, 2] -= SINK
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    return model, data


class Mujoco(Simulation):
    """MuJoCo's C engine on the exported MJCF, with central differences of whole rollouts."""

    def __init__(self) -> None:
        """Load the robot."""
        self.model, self.data = load_mjcf()

    def scores(self, offsets: np.ndarray, length: int) -> Iterator[float]:
        """Simulate, and yield the scalar after each step."""
        mujoco.mj_resetDataKeyframe(self.model, self.data, 0)
        for step in range(length):
            self.data.ctrl[:12] = joint_targets(step, offsets)[MOTORS]
            mujoco.mj_step(self.model, self.data)
            yield self.data.qpos[2] + SPEED_WEIGHT * self.data.qvel[2]

    def gradient(self, length: int) -> np.ndarray:
        """Return central differences with the step `STEP`."""
        return self.differences(STEP, (length,))[0]


class Mjx(Simulation):
    """MJX on the exported MJCF, in double precision; both passes are compiled once, for HORIZON physics steps."""

    def __init__(self, *, iterations: int) -> None:
        """Compile both passes; iterations: of the constraint solver.

        Raises ImportError: jax or mujoco-mjx is missing. Raises InputError: the simulation diverges.
        """
        jax, mjx, solver = (import_module(name) for name in ("jax", "mujoco.mjx", "mujoco.mjx._src.solver"))
        jax.config.update("jax_enable_x64", True)
        if iterations > 1:
            jax.lax.while_loop = partial(solver._while_loop_scan, max_iter=iterations)
        model, data = load_mjcf()
        model.opt.iterations, model.opt.ls_iterations = iterations, 20
        model.opt.tolerance = 1.0e-8 if iterations == 1 else 0.0
        robot, start = mjx.put_model(model, impl="jax"), mjx.put_data(model, data, impl="jax")
        base = np.array([joint_targets(step)[MOTORS] for step in range(HORIZON)])

        def scores(offsets: Any) -> Any:
            """Return the scalars of all steps."""

            def step(state: Any, target: Any) -> tuple[Any, Any]:
                """Advance one step; types of the state are kept, as a scan requires."""
                new = mjx.step(robot, state.replace(ctrl=state.ctrl.at[:12].set(target + offsets)))
                new = jax.tree.map(lambda a, b: a.astype(b.dtype), new, state)
                return new, new.qpos[2] + SPEED_WEIGHT * new.qvel[2]

            return jax.lax.scan(step, start, base)[1]

        forward = jax.jit(scores)
        self.scores = lambda offsets, _: np.array(forward(offsets))
        if not np.isfinite(self.forward(HORIZON)).all():
            raise InputError("the simulation diverges")
        reverse = jax.jit(jax.grad(lambda offsets, last: scores(offsets)[last])).lower(OFFSETS, 0).compile()
        self.gradient = lambda length: np.array(reverse(OFFSETS, length - 1))
        self.memory = reverse.memory_analysis().temp_size_in_bytes / HORIZON


class Newton(Simulation):
    """One of Newton's solvers, in single precision, with Warp's tape."""

    steps = SINGLE_STEPS

    def __init__(self, kind: str) -> None:
        """Build the model with motors as Newton's joint targets, and capture one physics step as a graph.

        kind: mujoco, semi_implicit, featherstone or featherstone_fresh.
        """
        import newton

        model: Any = build_model(1, visuals=False, device="cpu", mujoco=kind == "mujoco")
        self.model = model
        model.requires_grad = True
        stiffness, damping, mode = np.zeros((3, model.joint_dof_count))
        driven = MOTOR_DOFS + (KNEE_DOFS if "featherstone" in kind else [])
        stiffness[driven], damping[driven], mode[driven] = 17.0, 0.8, int(newton.JointTargetMode.POSITION)
        damping[MOTOR_DOFS[::3]] = 1.8  # the lateral motors
        for name, values in (("ke", stiffness), ("kd", damping), ("mode", mode)):
            getattr(model, f"joint_target_{name}").assign(values)
        solvers = newton.solvers
        self._substeps, self._make = {
            "m": (1, lambda: solvers.SolverMuJoCo(model, njmax=64, nconmax=12)),
            "s": (50, lambda: solvers.SolverSemiImplicit(model, joint_attach_ke=4.0e3, joint_attach_kd=10.0)),
            "f": (8, lambda: solvers.SolverFeatherstone(model)),
        }[kind[0]]
        if kind != "mujoco":
            model.shape_material_kd.fill_(100.0)  # [N s/m], explicit steps are unstable with more
        self._fresh = kind.endswith("fresh")
        self._solver = self._make()
        self._pipeline = newton.CollisionPipeline(model, rigid_contact_max=8, broad_phase="explicit")
        newton.eval_fk(model, model.joint_q, model.joint_qd, model)  # new states begin with these poses
        self._state, self._control, self._contacts = model.state(), model.control(), self._pipeline.contacts()
        in_place = [self._state] * (self._substeps + 1)
        self._advance(in_place, self._control, self._contacts)  # compiles
        with wp.ScopedCapture() as capture:
            self._advance(in_place, self._control, self._contacts)
        self._graph: Any = capture.graph

    def _advance(self, states: list, control: Any, contacts: Any) -> None:
        """Simulate 1/480 s from the first to the last state; contacts: written at its beginning."""
        self._pipeline.collide(states[0], contacts)
        for before, after in itertools.pairwise(states):
            before.clear_forces()
            solver = self._make() if self._fresh and before is not after else self._solver
            solver.step(before, after, control, contacts, PHYSICS_DT / self._substeps)

    def scores(self, offsets: np.ndarray, length: int) -> Iterator[float]:
        """Simulate by replays of the graph, and yield the scalar after each step."""
        for name in ("joint_q", "joint_qd", "body_q", "body_qd"):
            getattr(self._state, name).assign(getattr(self.model, name))
        for step in range(length):
            if step in (0, HOLD):
                self._control.joint_target_q.assign(joint_targets(step, offsets))
            wp.capture_launch(self._graph)
            height, speed = (float(array.numpy()[0, 2]) for array in (self._state.body_q, self._state.body_qd))
            yield height + SPEED_WEIGHT * speed

    def forward(self, length: int) -> tuple[Any, list]:
        """Simulate with a new state for each step; return the last state and the controls."""
        controls = [self.model.control() for _ in range(2)]
        for step, control in zip((0, HOLD), controls, strict=True):
            control.joint_target_q.assign(joint_targets(step, OFFSETS))
        state = self.model.state()
        for step in range(length):
            states = [state, *(self.model.state() for _ in range(self._substeps))]
            self._advance(states, controls[step >= HOLD], self._pipeline.contacts())
            state = states[-1]
        return state, controls

    def gradient(self, length: int) -> np.ndarray:
        """Return the gradient by Warp's tape; the memory is what the process gains."""
        before = resident_memory()
        with wp.Tape() as tape:
            state, controls = self.forward(length)
        seeds = {}
        for array, weight in ((state.body_q, 1.0), (state.body_qd, SPEED_WEIGHT)):
            seed = np.zeros(array.numpy().shape)
            seed[0, 2] = weight
            seeds[array] = wp.array(seed, dtype=array.dtype)
        tape.backward(grads=seeds)
        self.memory = (resident_memory() - before) / length
        return np.sum([control.joint_target_q.grad.numpy()[MOTORS] for control in controls], axis=0)


def resident_memory() -> int:
    """Return the memory of this process [byte]."""
    return 4096 * int(Path("/proc/self/statm").read_text().split()[1])


SIMULATIONS: dict[str, Callable[[], Simulation]] = {
    "ours": partial(Ours, double=True), "ours_single": partial(Ours, double=False), "mujoco": Mujoco,
    "mjx": partial(Mjx, iterations=1), "mjx_8_iterations": partial(Mjx, iterations=8),
    **{f"newton_{kind}": partial(Newton, kind) for kind in KINDS},
}  # fmt: skip


@dataclass(frozen=True)
class Args(OutputArgs):
    """Flags of the comparison of gradients."""

    rivals: tuple[str, ...] = tuple(SIMULATIONS)  # Names of the simulations
    lengths: tuple[int, ...] = (32, 96, 288)  # Numbers of physics steps, multiples of 8 up to 288
    repeats: int = 5  # Number of timed repetitions, of which the least processor time counts


def relative(values: np.ndarray, reference: np.ndarray) -> float:
    """Return the largest difference relative to the largest entry of the reference."""
    return float(np.abs(values - reference).max() / np.abs(reference).max())


def measure(simulation: Simulation, lengths: tuple[int, ...], repeats: int) -> dict[str, float]:
    """Return errors of the gradient, uncertainty of the differences, cost and memory."""
    sweep = [simulation.differences(step, lengths) for step in simulation.steps]
    metrics = {}
    for column, length in enumerate(lengths):
        pairs = [(relative(wide[column], near[column]), near[column]) for wide, near in itertools.pairwise(sweep)]
        uncertainty, reference = min(pairs, key=lambda pair: pair[0])
        metrics[f"error_{length}"] = relative(simulation.gradient(length), reference)
        metrics[f"uncertainty_{length}"] = uncertainty
    timed = partial(timeit.repeat, timer=time.process_time, number=1, repeat=repeats)
    forward = min(timed(partial(simulation.forward, lengths[-1])))
    gradient = min(timed(partial(simulation.gradient, lengths[-1])))
    return metrics | {"bytes_a_step": simulation.memory, "forward_s": forward, "cost": gradient / forward}


def main(args: Args) -> dict:
    """Measure the gradients of the simulations, and return the metrics."""
    folder = output_dir("gradient_table", args.out)
    installed = {package.name: package.version for package in importlib.metadata.distributions()}
    values: dict[str, Any] = {f"version_{name}": installed.get(name, "none") for name in PACKAGES}
    for name in args.rivals:
        try:
            metrics = measure(SIMULATIONS[name](), args.lengths, args.repeats)
            values |= {f"{name}_{key}": value for key, value in metrics.items()}
        except (ImportError, InputError, KeyError) as error:
            announce(f"{name} is skipped: {error}")
    return report(args, folder, values, "Gradients through contact", [key for key in values if "error" in key])


if __name__ == "__main__":
    run_script(main, Args)

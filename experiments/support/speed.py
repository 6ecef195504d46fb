"""Timing of solver, environment and training, each after a check of its outcome."""

from __future__ import annotations

import contextlib
import io
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
import warp as wp

from jumper_warp.envs.env import Env
from jumper_warp.policies.policy import load_policy
from jumper_warp.registry import make_task
from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.rl.fused import make_ppo
from jumper_warp.rl.logger import Stopwatch
from jumper_warp.robot.model import PHYSICS_DT, build_model
from jumper_warp.sim.dynamics import WorldRange
from jumper_warp.sim.mujoco import MujocoDynamics, mujoco_solver
from jumper_warp.sim.simulation import SUBSTEPS, Simulation, SlicedGraph, SolverName
from support.timing import device_memory, median_time, wall_time

SQUAT, DEFAULT, EXTEND = 110.0, 45.0, -10.0  # [deg] Commanded transversal angles of the scripted jump
JUMP_STEPS = 45  # Number of timed policy steps of the scripted jump: push-off, flight, landing
POLICY_STEPS = 120  # Policy steps of the timed jumps of a policy
CALLS = 3  # Number of launches of a part of a policy step per repetition


def command(sim: Simulation, degrees: float, steps: int) -> float:
    """Simulate robots with all transversal motors commanded to an angle [deg]; return the wall time per step [s]."""
    target = np.tile([0.0, 1.0, 1.0], 4) * np.radians(degrees)
    sim.target.assign(np.repeat(target[:, None], sim.num_worlds, axis=1).astype(np.float32))
    return wall_time(sim.step, sim.device, steps)


def check_standing(sim: Simulation, highest: float) -> None:
    """Raise RuntimeError unless the base height of every robot is between 0.33 m and `highest` [m]."""
    height = sim.joint_q()[:, 2]
    if not (np.all(height > 0.33) and np.all(height < highest)):
        raise RuntimeError(f"the robots do not stand: heights {height.min():.3f} to {height.max():.3f} m")


def time_standing(sim: Simulation, steps: int, repeats: int) -> float:
    """Time the simulation of standing robots: return the median wall time per policy step [s].

    Raises RuntimeError: a robot does not stand.
    steps: policy steps in each of `repeats` repetitions.
    """
    command(sim, DEFAULT, 90)
    check_standing(sim, 0.37)
    return median_time(sim.step, sim.device, steps, repeats)


def time_jump(sim: Simulation, repeats: int) -> tuple[float, float]:
    """Time the simulation of jumping robots: return the median wall time per policy step [s] and the mean apex [m].

    Raises RuntimeError: a robot does not reach 0.8 m.
    """
    times = []
    apex = np.zeros(1)
    push = JUMP_STEPS // 3
    for repeat in range(repeats + 1):
        command(sim, DEFAULT, 60)
        command(sim, SQUAT, 40)
        first = push * command(sim, EXTEND, push)
        if repeat > 0:
            rest = JUMP_STEPS - push
            times.append((first + rest * command(sim, DEFAULT, rest)) / JUMP_STEPS)
            continue
        for _ in range(JUMP_STEPS - push):  # the first jump only checks the outcome
            command(sim, DEFAULT, 1)
            apex = np.maximum(apex, sim.joint_q()[:, 2])
        if not np.all(apex > 0.8):
            raise RuntimeError(f"the robots do not jump: apex {apex.min():.3f} to {apex.max():.3f} m")
    return float(np.median(times)), float(apex.mean())


def time_solver(
    solver: SolverName, envs: int, steps: int, repeats: int, device: str | None, refine: int = 1, **settings: Any
) -> dict[str, float]:
    """Time one solver with standing and jumping robots, and return the metrics.

    envs: number of environments; steps: in each repetition of standing; refine, settings: of SolverMuJoCo, factor on
    the number of physics steps, and arguments of `mujoco_solver`.
    """
    build_model(1, device=device)  # Newton's own modules are not part of the metrics
    before = device_memory(wp.get_device(device))
    sims = []

    def build() -> None:
        """Build the simulation, compile its kernels and capture its graph."""
        finer = {"dt": PHYSICS_DT / refine, "substeps": SUBSTEPS * refine} if solver == "mujoco" else {}
        sims.append(Simulation(envs, solver=solver, observe_forces=False, visuals=False, device=device, **finer))
        if isinstance(sims[0].dynamics, MujocoDynamics):
            sims[0].dynamics.solver = mujoco_solver(sims[0].model, dt=sims[0].dt, **settings)
        sims[0].step()
        sims[0].step()

    values = {"setup_s": wall_time(build, device)}
    (sim,) = sims
    values["ms_per_step_standing"] = 1e3 * time_standing(sim, steps, repeats)
    jump, values["apex_m"] = time_jump(sim, repeats)
    values["ms_per_step_jump"] = 1e3 * jump
    values |= {f"steps_per_s_{phase}": 1e3 * envs / values[f"ms_per_step_{phase}"] for phase in ("standing", "jump")}
    if sim.device.is_cuda:
        values["memory_kib_per_env"] = (device_memory(sim.device) - before) / envs / 1024.0
    if solver == "jumper":
        values["largest_residual_m_s"] = float(sim.solver.residual.numpy().max())
        values["most_sweeps"] = int(sim.solver.sweeps.numpy().max())
    return values


def standing_solver(envs: int, device: str | None) -> Callable[[], None]:
    """Return a function that replays the graph of a policy step of motors and physics, with standing robots."""
    task = make_task("vertical-jump")
    sim = Simulation(envs, motors=task.motors, visuals=False, device=device)
    for _ in range(60):
        sim.step()
    check_standing(sim, 0.40)

    def advance(worlds: WorldRange) -> None:
        """Advance a range of worlds by one policy step at constant targets; one CPU thread runs it."""
        sim.advance(sim.substeps, sim.target, bodies=False, worlds=worlds)

    graph_and_sim = (SlicedGraph(advance, sim.slices, sim.device), sim)  # the graph does not keep its arrays alive
    return lambda: graph_and_sim[0].replay()


def stepping_env(envs: int, device: str | None, threads: int | None = None) -> tuple[Env, Callable[[], None]]:
    """Return an environment in the middle of its episodes, and a function that steps it with random actions.

    The actions are drawn before, so that drawing them is not timed. Raises RuntimeError: too many episodes diverge.
    """
    env = Env(make_task("vertical-jump"), envs, device=device, threads=threads)
    actions = torch.rand(16, envs, env.num_actions, device=env.device) * 2.0 - 1.0
    count = 0

    def step() -> None:
        """Run one policy step with the next of the random actions."""
        nonlocal count
        env.step(actions[count % len(actions)])
        count += 1

    env.reset()
    for _ in range(100):
        step()
    metrics = env.metrics()
    if not bool(env.obs.isfinite().all()) or metrics["Episode_Termination/diverged"] > 0.01:
        raise RuntimeError(f"{100 * metrics['Episode_Termination/diverged']:.1f} % of the episodes diverged")
    return env, step


def time_policy(envs: int, repeats: int, device: str | None, solver: SolverName = "jumper") -> float:
    """Time an environment whose robots jump: return the median wall time per policy step [s].

    The actions of the project's policy `vertical_jump` are recorded, and repeated from the same state, so that its
    network is not timed.
    Raises RuntimeError: fewer than half of the robots reach 0.5 m.
    """
    env = Env(make_task("vertical-jump"), envs, device=device, solver=solver)
    policy = load_policy("vertical_jump", env.device)
    env.reset()
    start = env.state_dict()
    highest = np.zeros(envs)
    actions = []
    for _ in range(POLICY_STEPS):
        actions.append(policy.act(env.obs))
        env.step(actions[-1])
        highest = np.maximum(highest, env.sim.joint_q()[:, 2])
    if np.median(highest) < 0.5:
        raise RuntimeError(f"the robots do not jump: median of their apexes {np.median(highest):.3f} m")
    times = []
    for _ in range(repeats):
        env.load_state_dict(start)
        remaining = iter(actions)
        times.append(wall_time(lambda remaining=remaining: env.step(next(remaining)), device, POLICY_STEPS))
    return float(np.median(times))


def time_threads(envs: int, threads: Sequence[int], steps: int, repeats: int) -> dict[str, float]:
    """Measure policy steps per second on a CPU by number of threads, and the speedup from the first number to the last.

    Repetitions alternate and the fastest counts, as other load only slows them down. `thread_speedup` is the smaller
    speedup of physics and environment.
    """
    step_functions: dict[str, list[Callable[[], object]]] = {"physics": [], "env": []}
    for n in threads:
        sim = Simulation(envs, visuals=False, device="cpu", threads=n)
        command(sim, DEFAULT, 90)
        step_functions["physics"].append(sim.step)
        step_functions["env"].append(stepping_env(envs, "cpu", n)[1])
    metrics = {}
    for name, functions in step_functions.items():
        times = np.array([[wall_time(step, "cpu", steps) for step in functions] for _ in range(repeats)]).min(axis=0)
        metrics |= {f"{name}_steps_per_s_threads_{n}": envs / t for n, t in zip(threads, times, strict=True)}
        metrics[f"thread_speedup_{name}"] = float(times[0] / times[-1])
    return metrics | {"thread_speedup": min(metrics[f"thread_speedup_{name}"] for name in step_functions)}


def time_stages(envs: int, device: str | None, repeats: int) -> dict[str, float]:
    """Time each part of a policy step of the environment: return the median wall times [s] by name.

    Names are those of `Env.stages`; every part begins from the same state.
    """
    env, _ = stepping_env(envs, device)
    saved = env.state_dict()
    parts = {}
    for name in env.stages():
        graph = SlicedGraph(lambda worlds, name=name: env.stages(worlds)[name](), env.sim.slices, env.wp_device)
        parts[name] = median_time(graph.replay, device, CALLS, repeats)
        env.load_state_dict(saved)
    return parts


def time_parts(envs: Sequence[int], train_envs: int, steps: int, repeats: int, device: str | None) -> dict[str, float]:
    """Time solver and environment for numbers of environments, and the parts of a policy step.

    Keys: `solver_` and `env_steps_per_s_<n>`, `env_steps_per_s_policy_<n>`, `<part>_us` and `<part>_share`.
    envs, train_envs: numbers of environments; parts of a policy step and a policy's jumps are timed with train_envs.
    """
    values: dict[str, float] = {}
    for n in sorted({*envs, train_envs}):
        functions = standing_solver(n, device), stepping_env(n, device)[1]
        solver, step = (median_time(function, device, steps, repeats) for function in functions)
        values |= {f"solver_steps_per_s_{n}": n / solver, f"env_steps_per_s_{n}": n / step}
        if n == train_envs:
            values["env_step_us"] = 1e6 * step
            values[f"env_steps_per_s_policy_{n}"] = n / time_policy(n, repeats, device)
    parts = time_stages(train_envs, device, repeats)
    values |= {f"{part}_us": 1e6 * wall for part, wall in parts.items()}
    return values | {f"{part}_share": wall / sum(parts.values()) for part, wall in parts.items()}


def time_ppo(envs: int, cfg: PpoCfg, iterations: int, device: str | None) -> dict[str, float]:
    """Time training with this package's PPO, and return the metrics.

    Raises RuntimeError: policy unchanged or not finite.
    `ppo_device_memory_gib`: total memory in use on the GPU. `ppo_ready_s`: time of compilation and first iterations,
    until all graphs are captured.
    """
    env, _ = stepping_env(envs, device)
    begin = time.perf_counter()
    ppo = make_ppo(env, cfg)
    before = ppo.model.log_std.detach().clone()
    ppo.compile()
    for _ in range(3):  # eager, capture, replay
        ppo.iterate()
    wp.synchronize_device(device)
    ready = time.perf_counter() - begin
    stopwatch = Stopwatch(env.device)

    def iterate() -> None:
        """Run one PPO iteration, and stop the time of each of its parts."""
        stopwatch.start()
        ppo.iterate(mark=stopwatch.mark)

    wall = wall_time(iterate, device, iterations)
    (collect, update), _ = stopwatch.read()
    after = ppo.model.log_std.detach()
    if not bool(after.isfinite().all()) or torch.equal(after, before):
        raise RuntimeError("the policy did not learn")
    metrics = {"ppo_steps_per_s": cfg.num_steps * envs / wall, "ppo_iteration_s": wall, "ppo_ready_s": ready}
    if memory := device_memory(wp.get_device(device)):
        metrics["ppo_device_memory_gib"] = memory / 2**30
    return {**metrics, "ppo_collect_s": collect, "ppo_update_s": update}


def time_rsl_rl(envs: int, num_steps: int, iterations: int, device: str | None) -> dict[str, float]:
    """Time training with rsl-rl-lib on the same environment and settings, and return the metrics."""
    from rsl_rl.runners import OnPolicyRunner

    from jumper_warp.envs.rsl_rl import RslRlVecEnv
    from jumper_warp.rl.rsl_rl import rsl_rl_config

    env, _ = stepping_env(envs, device)
    with contextlib.redirect_stdout(io.StringIO()):
        config = rsl_rl_config(PpoCfg(num_steps=num_steps), save_interval=10**6, seed=1)
        runner = OnPolicyRunner(RslRlVecEnv(env, num_steps), config, log_dir=None, device=str(env.device))
        runner.learn(2)
        wall = wall_time(lambda: runner.learn(iterations), device) / iterations
    return {"rsl_rl_steps_per_s": num_steps * envs / wall, "rsl_rl_iteration_s": wall}

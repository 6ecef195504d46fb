"""Whole-jump predictive control: a jump is planned again at every policy step, by gradients of the full dynamics.

The controller begins with the jump that the policy makes in the simulation of the assumed robot. While the robot waits
for its command, it improves the jump from the state at the command; from then on, the rest of the jump from the present
state. After the landing the policy takes over as soon as the assumed robot comes to rest with it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from jumper_warp.envs.env import Env
from jumper_warp.kernels.jump.state import LANDED
from jumper_warp.policies.policy import Policy
from jumper_warp.tasks.jump.evaluation import JumpEvaluation
from jumper_warp.trajectory.plan import LONGEST, SUBSTEPS, Plan, PlanModel, Start
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.rotations import turn_plane

SETTLED = 30  # Policy steps of a plan after the touchdown
SHORTEST = 20  # Policy steps that a plan looks ahead, at least
SPARE = 1000  # Policy steps that a plan repeats its last actions
SCALES = (1.0, 0.8, 0.6, 0.4, 0.25)  # [1] Factors on the goals of the policy's jumps that plans begin with
STANDING_HEIGHT = 0.3  # [m] Height of the base from which the scale of a commanded height counts
CHECKS = (2, 7, 12, 18, 24, 30, 40)  # Policy steps after touchdown at which the policy may take over
CHECKED = 30  # Policy steps after which the robot must rest with the policy
REST_SPEED = 0.1  # [m/s] Speed of the base of a robot at rest
ASSUMED = ("parameters.", "motors.", "robot.body_com", "nominal", "seed", "condition")
"""Beginnings of the names of an environment's state that are the assumed robots', see `jumper_warp.envs.state`."""


class PredictiveController:
    """Controller of one jump of each robot, that plans with assumed robots; see the module.

    It reads the state of the robots as an estimator without errors would return it, and the phase of the jump.

    Attributes:
        cost: (num_envs,) [1] cost of the present plans.
        plan: actions of the jump from its command on.
        first_iterations: iterations before the first policy step.
        length: policy steps from the command to the end of the plan.
    """

    def __init__(
        self, env: Env, policy: Policy, assumed: Env, *, iterations: int = 2, scales: Sequence[float] = SCALES,
        substeps: int = SUBSTEPS, threads: int | None = None, longest: int = LONGEST,
    ) -> None:  # fmt: skip
        """Prepare the control of the robots of `env`; plans begin at its next reset.

        assumed: environment of the robots as plans assume them, of the same task and num_envs. iterations: of the
        optimisation in a policy step. scales [1]: factors on the goal of the policy's jumps of which the best one is
        the first plan; 1 is always among them. substeps: physics steps of a plan in a policy step. threads: as in
        `Rollout`. longest: policy steps of the longest plan.
        Raises InputError: the task is no jump, or has no SolverJumper.
        """
        robots = assumed.snapshot()
        if not isinstance(env.task.evaluation, JumpEvaluation) or robots.solver != "SolverJumper":
            raise InputError(f"predictive control needs a jump on SolverJumper, not {env.task.name} on {robots.solver}")
        self.env = env
        self.policy = policy
        self.assumed = assumed
        self.iterations = iterations
        self.first_iterations = 0
        self.scales = scales
        self.longest = longest
        self.model = PlanModel(robots, np.zeros((3, env.num_envs)), substeps=substeps, threads=threads)

    def act(self, obs: torch.Tensor) -> torch.Tensor:
        """Return the actions (num_envs, 12) for the environment's present state; obs: of the policy."""
        arrays = self.env.task_arrays()
        if (arrays["steps"] == 0).all():
            self.begin()
        landed = np.where(arrays["phase"] == int(LANDED), arrays["phase_steps"], -1)
        due = np.isin(landed, CHECKS) & ~self.stands
        waits = arrays["steps"] < arrays["command_step"]
        at = np.maximum(arrays["steps"] - arrays["command_step"], 0)
        if due.any():
            self.stands |= due & self._rests_with_policy()
        elif waits.all():
            self.cost = self.plan.explore(self.model, self.start, self.length, self.iterations)
        elif not self.stands.all():
            horizon = max(self.length - int(at.min()), SHORTEST)
            self.cost = self.plan.improve(self.model, start_of(self.env), at, horizon, self.iterations)
        planned = torch.as_tensor(self.plan.actions[at, :, np.arange(len(at))], dtype=obs.dtype, device=obs.device)
        by_policy = torch.as_tensor(waits | self.stands, device=obs.device)[:, None]
        return torch.where(by_policy, self.policy.act(obs), planned)

    def begin(self) -> None:
        """Begin plans with the best of the policy's jumps to the scaled goals, simulated with the assumed robots."""
        arrays = self.env.task_arrays()
        self.model.goal = arrays["goal"].T.astype(float)
        self.stands = np.zeros(self.env.num_envs, dtype=bool)
        self.cost = np.full(self.env.num_envs, np.inf)
        touchdown = np.zeros(self.env.num_envs, dtype=int)
        actions = np.zeros((self.longest, 12, self.env.num_envs))
        for scale in dict.fromkeys((1.0, *self.scales)):
            tried = self._policy_jump(arrays, scale)
            outlook = self.model.simulate(tried, self.start)
            better = outlook.cost < self.cost
            self.cost = np.where(better, outlook.cost, self.cost)
            touchdown = np.where(better, outlook.touchdown, touchdown)
            actions = np.where(better, tried, actions)
        self.length = min(int(touchdown.max()) + SETTLED, self.longest)
        self.plan = Plan(np.pad(actions, ((0, SPARE), (0, 0), (0, 0)), mode="edge"))
        if self.first_iterations:
            self.plan.explore(self.model, self.start, self.length, self.first_iterations)

    def _policy_jump(self, arrays: dict[str, np.ndarray], scale: float) -> np.ndarray:
        """Return the policy's actions of a jump of the assumed robots from the command on, (longest, 12, num_envs).

        At scale 1, the true goal, `start` becomes their state at the command. arrays: of `Env.task_arrays`; scale [1]:
        of the goal.
        """
        place = turn_plane((arrays["goal"] - arrays["start"])[:, :2], -arrays["heading"])
        height = arrays["goal"][:, 2]
        height = np.where(height > 0.0, STANDING_HEIGHT + scale * (height - STANDING_HEIGHT), 0.0)
        commands = np.column_stack([scale * place, height, arrays["command_step"]])
        env = self.assumed
        env.evaluation_reset(commands.astype(np.float32), arrays["heading"])
        wait = int(arrays["command_step"].min())
        actions = []
        for i in range(wait + self.longest):
            if i == wait and scale == 1.0:
                self.start = start_of(env)
                self.model.pose = self.start.q[7:].astype(float)
            actions.append(self.policy.act(env.obs).clamp(-1.0, 1.0).cpu().numpy().T.astype(float))
            env.step(self.policy.act(env.obs))
        return np.stack(actions[wait:])

    def _rests_with_policy(self) -> np.ndarray:
        """Return whether each of the assumed robots comes to rest with the policy from the present state."""
        env = self.assumed
        own = env.state_dict()
        state = self.env.state_dict()
        env.load_state_dict({name: own[name] if name.startswith(ASSUMED) else state[name] for name in own})
        failed = np.zeros(env.num_envs, dtype=bool)
        for _ in range(CHECKED):
            env.step(self.policy.act(env.obs))
            failed |= env.task_arrays()["termination"] >= 0
        return ~failed & (np.linalg.norm(env.task_arrays()["base_vel"], axis=1) < REST_SPEED)


def start_of(env: Env) -> Start:
    """Return the present state of an environment's robots as the start of a plan."""
    robots = env.snapshot()
    arrays = env.task_arrays()
    q, qd, target = (tensor.cpu().numpy().copy() for tensor in (robots.q, robots.qd, robots.initial_target))
    return Start(q, qd, target, arrays["phase"], np.where(arrays["phase"] > 0, arrays["max_height"], 0.0))

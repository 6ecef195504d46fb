"""Trajectory optimisation: knots, terms of jumps against the simulation, and descents with known minima."""

import math
from typing import NamedTuple

import numpy as np
import pytest
import torch

from jumper_warp.diff.rollout import Rollout
from jumper_warp.robot.model import build_model
from jumper_warp.robot.motors import jumping_motors, vertical_jump_filter
from jumper_warp.sim.simulation import Simulation
from jumper_warp.tasks.jump.horizontal import LANDING_HEIGHT
from jumper_warp.trajectory import jumps
from jumper_warp.trajectory.augmented_lagrangian import minimise
from jumper_warp.trajectory.problem import Knots, Problem, SimulatedMotion, Values
from jumper_warp.trajectory.smoothing import SHIFT, Stage, crossed, descend, smoothed

KNOTS = Knots((0.0, 8.0, 14.0, 18.0, 22.0), steps=36)
SQUAT_AND_PUSH = np.array([[0.0] * 4, [0.5] * 4, [0.5] * 4, [-0.4, -0.4, -0.5, -0.4], [-0.5] * 4])
"""(5 knots, 4) Actions of front outer, front inner, hind outer and hind inner motors."""
pytestmark = pytest.mark.usefixtures("one_thread")


def problem(objective=None, constraints=(), **settings) -> Problem:
    """Return a problem of a jump from standing with `KNOTS`, by default to the highest apex; settings: of `Problem`."""
    settings = {"command_filter": vertical_jump_filter(), "threads": 1} | settings
    return Problem(KNOTS, objective or jumps.highest(), constraints, jumping_motors(18.0), **settings)


class Jump(NamedTuple):
    """A jump from standing by a squat and a push-off."""

    problem: Problem
    x: torch.Tensor  # (1, 20) candidate: `SQUAT_AND_PUSH`
    motion: SimulatedMotion  # of x, without gradients


@pytest.fixture(scope="module")
def jump():
    """Return the `Jump`."""
    jump_problem = problem()
    x = torch.as_tensor(SQUAT_AND_PUSH.reshape(1, -1))
    with torch.no_grad():
        return Jump(jump_problem, x, jump_problem.motion(x))


# ---------------------------------------------------------------- knots


def test_symmetric_knots_interpolate_targets_and_keep_the_last():
    x = np.zeros((1, len(KNOTS)))
    x[0, 4:8] = [1.0, -0.5, 0.25, 0.0]  # front outer, front inner, hind outer, hind inner at step 8
    targets = np.degrees(KNOTS.targets(torch.as_tensor(x))[..., 0].numpy())  # (steps, 12)
    change = np.array([0.0, 90.0, -45.0, 0.0, 90.0, -45.0, 0.0, 22.5, 0.0, 0.0, 22.5, 0.0])  # [deg], 90 by an action
    middle = np.tile([0.0, 45.0, 45.0], 4)
    assert targets[8] == pytest.approx(middle + change)
    assert targets[4] == pytest.approx(middle + 0.5 * change)
    assert targets[30] == pytest.approx(middle)


def test_asymmetric_knots_set_all_motors():
    knots = Knots((0.0, 3.0), steps=5, symmetric=False)
    x = np.random.default_rng(0).uniform(-1.0, 1.0, (2, len(knots)))
    targets = knots.targets(torch.as_tensor(x)).numpy()
    scale, middle = np.tile([15.0, 90.0, 90.0], 4), np.tile([0.0, 45.0, 45.0], 4)
    assert np.degrees(targets[4, :, 1]) == pytest.approx(middle + scale * x[1, 12:])  # the last knot's actions


# ---------------------------------------------------------------- jumps


def test_air_time_matches_projectile():
    up, drop = torch.tensor([[3.0, 0.0, -1.0], [0.2, 0.45, 0.3]], dtype=torch.float64)  # [m/s], [m]
    time = jumps.air_time(up, drop, 9.81)
    assert (drop + up * time - 0.5 * 9.81 * time**2).numpy() == pytest.approx(0.0, abs=1e-12)  # [m]


def test_momentum_in_flight_follows_a_parabola(jump):
    """For six policy steps after takeoff gravity is the only force, and angular momentum is conserved."""
    _, _, motion = jump
    row, takes_off = motion.takeoff(0.25)  # [m/s]
    assert takes_off.all() and motion.q.shape[0] - int(row) > 6
    takeoff, later = motion.momentum_at(row), motion.momentum_at(row + 6)
    time, down = 6 * motion.substeps * motion.dt, torch.tensor([0.0, 0.0, -1.0])
    assert later.vel.numpy() == pytest.approx((takeoff.vel + 9.81 * time * down).numpy(), abs=0.015)  # [m/s]
    # time + dt: the semi-implicit step falls by g dt^2 (1 + 2 + ... + n) = g time (time + dt) / 2
    expected = takeoff.com + time * takeoff.vel + 0.5 * 9.81 * time * (time + motion.dt) * down
    assert later.com.numpy() == pytest.approx(expected.numpy(), abs=2e-3)  # [m]
    assert later.spin.numpy() == pytest.approx(takeoff.spin.numpy(), abs=0.02)  # [kg m^2/s]


def test_farthest_is_the_distance_of_a_projectile_to_the_tasks_landing_height(jump):
    motion = jump.motion
    start, takeoff = motion.start, motion.momentum_at_takeoff(0.25)
    landing = LANDING_HEIGHT + float(start.com[0, 2] - motion.q[0, 0, 2])  # of the com
    (ahead, _, up), (x, _, z) = takeoff.vel[0].tolist(), takeoff.com[0].tolist()
    time = np.roots([-0.5 * 9.81, up, z - landing]).max()
    assert -float(jumps.farthest()(motion)) == pytest.approx(x - float(start.com[0, 0]) + ahead * time, abs=1e-6)


def test_motion_and_apex_match_simulation(jump):
    jump_problem, x, motion = jump
    settings = {name: getattr(jump_problem, name) for name in ("motors", "command_filter", "friction")}
    sim = Simulation(1, **settings, device="cpu")
    targets, heights = jump_problem.knots.targets(x)[..., 0].numpy(), []
    for target in targets:
        sim.target.assign(target[:, None].astype(np.float32))
        sim.step()
        heights.append(sim.joint_q()[0, 2])
    assert max(heights) > 0.6
    assert heights == pytest.approx(motion.q[1:, 0, 2].numpy(), abs=1e-3)  # [m]
    assert -float(jumps.highest()(motion)) == pytest.approx(max(heights), abs=3e-3)  # [m]


def test_positive_work_matches_sum_over_physics_steps(jump):
    jump_problem, x, motion = jump
    fine = Rollout(
        build_model(1, visuals=False, friction=jump_problem.friction), jump_problem.motors,
        jump_problem.command_filter, double=True, tolerance=jump_problem.tolerance, every=1, threads=1,
    )  # fmt: skip
    exact = fine.run(jump_problem.knots.targets(x).numpy(), *fine.standing())
    rate, torque = exact.qd.numpy()[:, 6:, 0], exact.torque.numpy()[:, :, 0]
    power = torque * 0.5 * (rate[1:] + rate[:-1])  # [W]
    work = fine.dt * np.maximum(power, 0.0).sum()
    assert work > 50.0  # [J]
    assert float(motion.positive_work[-1, 0]) == pytest.approx(work, rel=0.03)


def test_highest_ignores_a_second_hop():
    """The motion is a small hop, a squat in the air and a jump; the apex is that of the hop."""
    jump_problem = problem()
    jump_problem.knots = Knots((0.0, 7.0, 8.0, 30.0, 31.0), steps=56)
    x = torch.full((1, 5, 4), -1.0, dtype=torch.float64)  # knots 0 and 1: push-off
    x[:, 2:4], x[:, 4] = 0.5, -0.5  # squat, push-off
    with torch.no_grad():
        motion = jump_problem.motion(x.reshape(1, -1))
    assert jump_problem.world_steps == 56  # one world
    height, row = motion.q[:, 0, 2].numpy(), int(motion.takeoff(0.25)[0])
    touchdown = row + int(motion.down[row:, :, 0].any(dim=1).int().argmax())
    assert row < 15 and height[touchdown:].max() > height[:touchdown].max() + 0.05  # [m]: the jump is higher
    assert -float(jumps.highest()(motion)) == pytest.approx(height[:touchdown].max(), abs=5e-3)


TERMS = {  # (num,) each; constraints of several rows are summed
    "farthest": jumps.farthest(),
    "highest": jumps.highest(),
    "positive_work": jumps.positive_work(),
    "landing_pitch": lambda motion: jumps.landing_pitch(0.5)(motion)[0],
    "stays": lambda motion: jumps.stays(0.3)(motion).sum(0),
    "leans_back": jumps.leans_back(1.0),
    "clear": lambda motion: jumps.clear()(motion).sum(0),
    "soft": lambda motion: jumps.soft(0.0, 0.25)(motion).sum(0),
    "upright": lambda motion: jumps.upright(0.2)(motion)[0],
}


def test_gradients_of_terms_match_central_differences():
    """Derivatives are along three random directions at `SQUAT_AND_PUSH`; terms are constraints, so each is returned."""
    rng, h = np.random.default_rng(1), 1.0e-6
    x = SQUAT_AND_PUSH.reshape(1, -1) + 0.02 * rng.normal(size=(1, len(KNOTS)))
    directions = rng.normal(size=(3, len(KNOTS)))
    ends = torch.as_tensor(np.concatenate([x + h * directions, x - h * directions]))
    whole = problem(TERMS["farthest"], list(TERMS.values()), tolerance=1e-13)
    with torch.no_grad():
        ahead, behind = whole.evaluate(ends).constraints.split(3)
    expected = ((ahead - behind) / (2.0 * h)).numpy()
    for i, name in enumerate(TERMS):
        _, gradient = whole.gradient(torch.as_tensor(x), lambda values, i=i: values.constraints[:, i])
        scale = np.abs(expected[:, i]).max()
        assert scale > 1e-4, name
        assert gradient.numpy()[0] @ directions.T == pytest.approx(expected[:, i], abs=1e-5 * scale), name


# ---------------------------------------------------------------- descent


class Bowl:
    """Stub of `Problem`: minimise (a - 0.6)^2 + 20 (b - 0.4)^2 of x = (a, b), subject to a + b <= 0.5."""

    def __init__(self):
        self.knots, self.double, self.world_steps, self.reverse_steps = range(2), True, 0, 0
        self.goal = torch.tensor([0.6, 0.4], dtype=torch.float64)
        self.device = "cpu"

    def rollout(self, num_worlds):
        """Return this stub, which counts steps as the `Rollout` of `num_worlds` worlds does."""
        return self

    def evaluate(self, x):
        """Return the `Values` of candidates x (n, 2): objective (n,) and constraint (n, 1), met where it is <= 0."""
        (a, b), (a_goal, b_goal) = x.T, self.goal
        self.world_steps += len(x)
        return Values((a - a_goal) ** 2 + 20.0 * (b - b_goal) ** 2, (a + b - 0.5)[:, None])

    def gradient(self, x, merit):
        """Return the `Values` of candidates x (n, 2), and the gradient (n, 2) of merit(values), (n,)."""
        x = x.detach().requires_grad_()
        values = self.evaluate(x)
        self.reverse_steps += len(x)
        return Values(*(v.detach() for v in values)), torch.autograd.grad(merit(values).sum(), x)[0]


# minimum of `Bowl`: a + b = 0.5 and equal slopes, a - 0.6 = 20 (b - 0.4)
NEAREST = np.array([0.6 - 20.0 * 0.5 / 21.0, 0.4 - 0.5 / 21.0])


def test_descent_finds_the_constrained_minimum_reproducibly():
    begin = np.array([[-0.9, 0.9], [0.9, -0.9], [-0.5, -0.5]])
    result, repeated = (minimise(Bowl(), begin, iterations=120) for _ in range(2))
    assert result.x == pytest.approx(np.tile(NEAREST, (3, 1)), abs=3e-3)
    assert (result.violation <= 1e-3).all()
    assert result.history[-1]["reverse_steps"] > 300  # 3 starts, 120 iterations
    assert np.array_equal(result.x, repeated.x)


def test_descent_stays_in_the_box():
    """The minimum without bounds is at a = 3; actions lie in -1 to 1."""
    bowl = Bowl()
    bowl.goal = torch.tensor([3.0, -0.2], dtype=torch.float64)
    bowl.evaluate = lambda x: Values((x - bowl.goal).square().sum(1), x.new_zeros(len(x), 0))
    result = minimise(bowl, np.zeros((1, 2)), iterations=40)
    assert result.x[0] == pytest.approx([1.0, -0.2], abs=1e-4)


def test_smoothed_descent_approaches_the_minimum():
    begin = np.random.default_rng(0).uniform(-1.0, 1.0, (64, 2))
    stages = (
        Stage(keep=8, iterations=60, rate=0.05, noise=0.05, final_fraction=1.0),
        Stage(keep=2, iterations=100, rate=0.03, noise=0.03, penalty=100.0),
    )
    result = smoothed(Bowl(), begin, stages=stages)
    assert result.shape == (2, 2) and result == pytest.approx(np.tile(NEAREST, (2, 1)), abs=0.03)


def test_multipliers_enforce_constraints_of_smoothed_descent():
    begin = torch.tensor([[0.5, 0.3]], dtype=torch.float64)
    violation = {}
    for dual in (0.0, 0.5):  # rate of the multipliers; 0: penalty alone
        stage = Stage(keep=1, iterations=300, rate=0.02, noise=0.02, penalty=1.0, dual=dual)
        violation[dual] = float(descend(Bowl(), begin, stage, np.random.default_rng(0)).sum() - 0.5)
    assert violation[0.0] > 0.1 and abs(violation[0.5]) < 0.02


def test_stage_with_slack_ends_at_best_feasible_points():
    """With a slack, a start ends at its best point that nearly meets the constraints, not at its last point."""
    begin = torch.tensor([[0.5, 0.3]], dtype=torch.float64)  # a + b = 0.8 violates the constraint
    stage = Stage(keep=1, iterations=300, rate=0.02, noise=0.02, penalty=1.0, dual=0.5, slack=0.5)
    result = descend(Bowl(), begin, stage, np.random.default_rng(0))
    assert float(result.sum() - 0.5) < 5e-3  # violation
    assert result[0].numpy() == pytest.approx(NEAREST, abs=0.05)


class Edge(Bowl):
    """`Bowl` with an objective of 5 where a > 0.45, and a constraint that is never active."""

    def evaluate(self, x):
        """As `Bowl.evaluate`."""
        values = super().evaluate(x)
        return Values(torch.where(x[:, 0] > 0.45, 5.0, values.objective), values.constraints - 1.0)


def test_starts_return_to_their_best_point_after_an_edge():
    begin = torch.tensor([[0.3, 0.4], [-0.5, 0.3]], dtype=torch.float64)
    ends = {}
    for slack in (math.inf, 0.1):
        stage = Stage(keep=2, iterations=120, rate=0.05, noise=0.01, final_fraction=1.0, slack=slack)
        ends[slack] = Edge().evaluate(descend(Edge(), begin, stage, np.random.default_rng(0))).objective
    assert (ends[math.inf] == 5.0).any()
    first = Edge().evaluate(begin).objective
    assert (ends[0.1] <= first).all() and ends[0.1][1] < first[1] - 1.0


def test_returned_starts_take_smaller_steps():
    begin, merit = torch.tensor([[0.2, 0.3]], dtype=torch.float64), {}
    settings = {"final_fraction": 1.0, "slack": 0.001, "check_every": 2}
    for scale in (1.0, 0.5):
        stage = Stage(keep=1, iterations=100, rate=0.3, noise=0.01, return_scale=scale, **settings)
        merit[scale] = float(Edge().evaluate(descend(Edge(), begin, stage, np.random.default_rng(0))).objective)
    assert merit[0.5] < 0.0226 < 0.1 < merit[1.0]  # the minimum is at the edge: (0.6 - 0.45)^2 = 0.0225


def test_crossings_join_a_beginning_with_another_end():
    """Three parents of 12 knots (entries: knot + 100 times parent) have 66 crossings each."""
    knots = Knots(tuple(map(float, range(12))), steps=12)
    rows = torch.arange(12.0)[:, None] + torch.tensor([0.0, 100.0, 200.0])[:, None, None]
    whole = crossed(knots, rows.expand(3, 12, 4).flatten(1), 66, np.random.default_rng(0)).reshape(198, 12, 4)
    assert (whole == whole[..., :1]).all()  # knots are moved whole
    parent, knot = torch.div(whole[..., 0], 100.0, rounding_mode="floor"), whole[..., 0] % 100.0
    assert (parent[:, 0] == torch.arange(3.0).repeat(66)).all()  # each crossing begins with its own parent
    assert (parent[:, 0] != parent[:, -1]).all()  # and ends with another parent
    assert ((parent.diff(dim=1) != 0.0).sum(1) == 1).all()  # after one change
    beginning = parent == parent[:, :1]
    assert (knot[beginning] == torch.arange(12.0).expand(198, 12)[beginning]).all()
    assert 0 < (knot - torch.arange(12.0)).abs().max() <= SHIFT  # some ends are shifted


def test_smoothed_search_uses_crossings():
    """The minimum, 0 at both knots, is the beginning of one start with the end of the other."""
    begin = np.array([[0.0] * 4 + [0.9] * 4, [0.9] * 4 + [0.0] * 4])  # (2 starts, 2 knots of 4 actions)
    bowl = Bowl()
    bowl.evaluate = lambda x: Values(x.square().sum(1), x.new_zeros(len(x), 0))
    bowl.knots = Knots((0.0, 1.0), steps=2)
    stage = Stage(keep=1, iterations=1, rate=1e-6, noise=1e-6, crossings=16)
    assert np.abs(smoothed(bowl, begin, stages=(stage,))).max() < 1e-3


def test_descent_raises_a_jump_within_its_constraints():
    """The objective is minus the apex height [m]; the result meets the constraints and has the reported objective."""
    jump_problem = problem(constraints=(jumps.clear(), jumps.upright(math.radians(10.0))))
    begin = SQUAT_AND_PUSH.reshape(1, -1)
    with torch.no_grad():
        before = jump_problem.evaluate(torch.as_tensor(begin))
    result = minimise(jump_problem, begin, iterations=6, step=0.05)
    assert result.objective[0] < float(before.objective) - 0.02  # [m]
    with torch.no_grad():
        after = jump_problem.evaluate(torch.as_tensor(result.x))
    assert float(after.objective) == pytest.approx(result.objective[0], abs=1e-9)
    assert float(after.constraints.max()) <= 1e-3

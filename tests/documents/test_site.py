"""Generators of the documentation site: references, links and docstrings."""

import re

import pytest

import cli_page
import mdp_page
import stock_terms
from jumper_warp import mdp
from jumper_warp.cli.main import COMMANDS
from jumper_warp.cli.train import SHORT_HELP
from jumper_warp.registry import TASKS, make_task
from repository import relocated


@pytest.fixture(scope="module")
def types_and_terms():
    """Return the text of the generated pages of types and terms by file name."""
    return mdp_page.mdp_pages()


@pytest.fixture(scope="module")
def command_line():
    """Return the text of the generated page of the command line."""
    return cli_page.cli_page()


def test_every_public_name_and_stock_term_is_described_once_and_linked(types_and_terms):
    spaces = set(stock_terms.SPACES)
    public = {
        f"jumper_warp.mdp.{name}" for name in vars(mdp) if name[0] != "_" and name not in {*spaces, "mirror", "vec12"}
    }
    stock = {name for space in spaces for name in stock_terms.stock_terms(space)}
    own = {name for space in spaces for kind in stock_terms.TASK_KINDS for name in stock_terms.task_terms(space, kind)}
    assert len(stock | own) > 80
    pages = "".join(text for name, text in types_and_terms.items() if name != "mdp.md")
    directives = re.findall(r"^`{4}\{py:\w+\} ([\w.]+)", pages, re.M)
    assert sorted(set(directives)) == sorted(directives)
    for name in public | stock | own:
        assert f"{{py:obj}}`~{name}`" in types_and_terms["mdp.md"]
        assert name.removeprefix("jumper_warp.mdp.").removeprefix("jumper_warp.kernels.") in directives


@pytest.mark.parametrize(
    "row",
    [
        r"| `lin_vel` | vec3 | \[m/s\] | velocity of the base origin, world |",
        r"| `torque` | array2d of float, `(12, num_worlds)` | \[N m\] | last physics step |",
        r"| `body_com` | array of vec3, `(21 num_worlds,)` | \[m\] | body axes |",
        r"| `time_out` | option | `False` |",
        r"| `latency` | `Range`, `(0.0, 16.0)` | \[ms\] Delay from action to motor",
        "ground_force(robot: RobotView, state: Any, weight_force: float) -> float",
        r"Angular velocity of the base \[rad/s\], body axes.",
    ],
)
def test_fields_and_terms_have_shapes_units_and_signatures(types_and_terms, row):
    assert any(row in text for text in types_and_terms.values())


def test_terms_name_the_tasks_that_use_them(types_and_terms):
    text = types_and_terms["rewards.md"].partition("jump.rewards.jump_height(")[2].partition("````")[0]
    assert "Used by `vertical-jump`" in text
    walks = [name for name in TASKS if make_task(name).state is mdp.VelocityState]
    assert stock_terms.words_for_tasks([*walks, "attitude"]) == "all walks, `attitude`"


def test_every_command_has_a_section_with_its_common_flags_before_the_collapsed_ones(command_line):
    assert [name for name in COMMANDS if f"## `jumper {name}" not in command_line] == []
    common = command_line.partition("## `jumper train TASK`")[2].partition("{dropdown}")[0]
    names = [name for name in SHORT_HELP if name != "task-module"]
    assert [name for name in names if f"--{name}" not in common and f"--[no-]{name}" not in common] == []
    assert "`--num-envs INT`\n: Number of simulated robots (worlds), over all processes. Default: `8192`." in common


def test_links_of_an_included_file_lead_from_the_including_page():
    text = "[a](picture.webp) [`b`](../x/README.md#top) [c](#here) [d](https://e.org) `[e](f)`"
    moved = relocated(text, "../assets/policies/y", "results/policies")
    assert moved == (
        "[a](../../../assets/policies/y/picture.webp) [`b`](../../../assets/policies/x/README.md#top)"
        " [c](#here) [d](https://e.org) `[e](f)`"
    )

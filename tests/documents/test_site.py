"""Generators of the documentation site: references, links and docstrings."""

import re

import pytest

import cli_page
import mdp_page
import stock_terms
from jumper_warp import mdp
from jumper_warp.cli.main import COMMANDS
from jumper_warp.cli.train import SHORT_HELP


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


def test_every_command_has_a_section_with_its_common_flags_before_the_collapsed_ones(command_line):
    assert [name for name in COMMANDS if f"## `jumper {name}" not in command_line] == []
    common = command_line.partition("## `jumper train TASK`")[2].partition("{dropdown}")[0]
    names = [name for name in SHORT_HELP if name != "task-module"]
    assert [name for name in names if f"--{name}" not in common and f"--[no-]{name}" not in common] == []
    assert "`--num-envs INT`\n: Number of simulated robots (worlds), over all processes. Default: `8192`." in common

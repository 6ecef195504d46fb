"""Snippets of Markdown pages: Sybil finds the fences of a page, which run in order in one namespace and one folder.

A fence ```python runs; if its first line is a comment with a file's name, it is written to that file. The commands of
a fence ```bash are checked: their flags are parsed. Comments on the lines above a fence change this:

    <!-- run -->              run the commands of a bash fence
    <!-- run: FLAGS -->       the same, with these flags added to each `jumper train`
    <!-- needs: MODULE -->    skip the fence where a module, or one of several with commas, is not installed
    <!-- skip: REASON -->     skip the fence
    <!-- file: NAME -->       write the fence, of any language, to a file
"""

import contextlib
import os
import re
import shlex
import sys
import traceback
import types
from importlib.util import find_spec
from pathlib import Path

import warp as wp
from sybil import Sybil
from sybil.parsers.markdown.lexers import FencedCodeBlockLexer

from jumper_warp.registry import TASKS
from snippet_commands import ROOT, CommandError, Commands, command_lines

COMMENT = re.compile(r"<!--\s*(run|needs|skip|file)\b:?\s*(.*?)\s*-->")
FILE_NAME = re.compile(r"#\s*([\w./-]+\.\w+)\s*\n")  # first line of a Python fence
LINKED = ("assets", "experiments")  # folders of the repository that a page's working folder has, too


class PageError(Exception):
    """Errors in the snippets of a page, each with page and line."""


class Page:
    """The snippets of one Markdown page."""

    def __init__(self, path):
        self.path, self.commands, self.errors = Path(path), Commands(), []
        self.name = str(self.path.relative_to(ROOT)) if self.path.is_relative_to(ROOT) else self.path.name
        self.module = types.ModuleType("snippets_of_" + re.sub(r"\W", "_", self.path.stem))
        self.document = Sybil([self.fences], path=str(self.path.parent)).parse(self.path)

    def fences(self, document):
        """Yield a region for each fence with a language: a Sybil parser."""
        for region in FencedCodeBlockLexer(r".+", {"language": "arguments", "source": "source"})(document):
            region.parsed = region.lexemes["arguments"].strip(), str(region.lexemes["source"])
            region.evaluator = self.evaluate
            yield region

    def run(self, folder):
        """Run all snippets in an empty folder, up to the first that fails. Raises PageError."""
        with clean_process(folder, self.module), contextlib.suppress(PageError):
            for example in self.document.examples():
                example.evaluate()
        if self.errors:
            raise PageError("\n".join(self.errors))

    def fail(self, line, message):
        """Add an error of a line and return it."""
        self.errors.append(f"{self.name}:{line}: {message}")
        return PageError(self.errors[-1])

    def evaluate(self, example):
        """Run, check, write or skip a fence; a Sybil evaluator. Raises PageError: the rest of the page cannot run."""
        (language, source), notes = example.parsed, notes_above(example)
        missing = [name for name in notes.get("needs", "").replace(" ", "").split(",") if name and not installed(name)]
        if "skip" in notes or missing:
            return
        named = FILE_NAME.match(source) if language == "python" else None
        if file := notes.get("file") or (named and named[1]):
            Path(file).parent.mkdir(parents=True, exist_ok=True)
            Path(file).write_text(source, encoding="utf-8")
        elif language == "python":
            self.run_python(example.line, source)
        elif language == "bash":
            self.evaluate_bash(example.line, source, notes)

    def run_python(self, line, source):
        """Execute a fence that opens at a line, so that tracebacks and Warp find its lines in the page."""
        try:
            exec(compile("\n" * line + source, str(self.path), "exec"), vars(self.module))
        except (Exception, SystemExit) as error:
            lines = [
                frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(self.path)
            ]
            if isinstance(error, SyntaxError) and error.filename == str(self.path):
                lines = [error.lineno]
            raise self.fail(lines[-1] if lines else line, f"{type(error).__name__}: {error}") from error

    def evaluate_bash(self, line, source, notes):
        """Check each command of a fence that opens at a line, or run it. Raises PageError: a run failed."""
        for number, words in command_lines(source, line + 1):
            forget_modules(Path.cwd())  # as in a new process
            try:
                if "run" in notes:
                    self.commands.run(words, shlex.split(notes["run"]))
                else:
                    self.commands.check(words)
            except CommandError as error:
                failed = self.fail(number, f"{shlex.join(words)}: {error}")
                if "run" in notes:
                    raise failed from error
            except Exception as error:
                raise self.fail(number, f"{shlex.join(words)}: {type(error).__name__}: {error}") from error


def installed(name):
    """Return whether a module is installed."""
    try:
        return find_spec(name) is not None
    except ModuleNotFoundError:  # its package is not
        return False


def notes_above(example):
    """Return the comments directly above a fence: text by word, such as {"run": "--num-envs 64"}."""
    notes = {}
    for line in reversed(example.document.text[: example.region.start].splitlines()):
        comment = COMMENT.fullmatch(line.strip())
        if comment:
            notes[comment[1]] = comment[2]
        elif line.strip():
            break
    return notes


def forget_modules(folder, first=()):
    """Remove modules whose files lie in a folder, and those named in `first`, from sys.modules."""
    for name, module in list(sys.modules.items()):
        file = getattr(module, "__file__", None)
        if name in first or (isinstance(file, str) and Path(file).is_relative_to(folder)):
            del sys.modules[name]


@contextlib.contextmanager
def clean_process(folder, module):
    """Work in a folder on the CPU with a module for the snippets; restore tasks, modules, paths and environment."""
    before = dict(TASKS), list(sys.path), dict(os.environ), Path.cwd()
    environments = getattr(sys.modules.get("gymnasium"), "registry", {})
    registered = dict(environments)
    folder = Path(folder).resolve()
    for name in LINKED:
        (folder / name).symlink_to(ROOT / name)
    sys.modules[module.__name__] = module
    sys.path.insert(0, str(folder))
    os.chdir(folder)
    try:
        with wp.ScopedDevice("cpu"):
            yield
    finally:
        os.chdir(before[3])
        forget_modules(folder, [module.__name__])
        sys.path[:] = before[1]
        for live, saved in ((TASKS, before[0]), (os.environ, before[2]), (environments, registered)):
            live.clear()
            live.update(saved)
        if plots := sys.modules.get("matplotlib.pyplot"):
            plots.close("all")

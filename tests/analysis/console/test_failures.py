"""What a command says of an error and its exit code, through the command's own `main`."""

import errno

import numpy as np
import pytest
import torch
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from analysis.commands import cli
from analysis.console.failures import report
from analysis.console.plain import say
from landscape.errors import InputError

TRACEBACK = "Traceback (most recent call last)"


def ended(monkeypatch, capsys, error: BaseException, *more: str) -> tuple[int, str]:
    """The exit code and what is on stderr, of a command that this error ends."""

    def fail(*_):
        raise error

    monkeypatch.setattr(cli, "run", fail)
    code = cli.main([*more, "demo"])
    return code, capsys.readouterr().err


@pytest.mark.parametrize(
    ("error", "code", "words"),
    [
        (InputError("expected a scene,\ngot none"), 2, "expected a scene, got none"),
        (FileNotFoundError("expected a scene folder, x does not exist"), 2, "expected a scene folder"),
        (IsADirectoryError(errno.EISDIR, "Is a directory", "a/b"), 2, "cannot use a/b: Is a directory"),
        (MemoryError(), 71, "memory ran out"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 9 bytes"), 71, "memory ran"),
        (torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB"), 71, "memory ran out"),
        (np._core._exceptions._ArrayMemoryError((9,), np.dtype("f8")), 71, "memory ran out"),  # pyright: ignore[reportAttributeAccessIssue]
        (OSError(errno.ENOSPC, "No space left on device", "run/metrics.json"), 74, "disk is full (run/metrics.json)"),
        (OSError(errno.EDQUOT, "Disk quota exceeded"), 74, "the disk is full"),
        (KeyboardInterrupt(), 130, "interrupted"),
    ],
    ids=lambda value: type(value).__name__,
)
def test_one_sentence_for_what_is_no_fault_of_the_program(monkeypatch, capsys, error, code, words):
    found, said = ended(monkeypatch, capsys, error)
    assert found == code and words in said
    assert said.startswith("landscape: ") and said.count("\n") == 1


def test_what_a_command_lacks_is_added_to_it(monkeypatch, capsys):
    error = InputError("expected --views N, got none")
    error.add_note("--views 3")
    code, said = ended(monkeypatch, capsys, error)
    assert (code, said) == (2, "landscape: expected --views N, got none; take: landscape demo --views 3\n")


@pytest.mark.parametrize("error", [ValueError("shapes"), KeyError("x"), AssertionError(), OSError(errno.EIO, "I/O")])
def test_a_fault_shows_its_traceback_and_how_to_report_it(monkeypatch, capsys, error):
    code, said = ended(monkeypatch, capsys, error)
    assert code == 70 and said.startswith(TRACEBACK)
    assert said.splitlines()[-2] == "command: landscape demo" and "please report it" in said.splitlines()[-1]


def test_debug_shows_the_traceback_before_and_after_the_subcommand(monkeypatch, capsys):
    code, said = ended(monkeypatch, capsys, InputError("expected less"), "--debug")
    assert code == 2 and said.startswith(TRACEBACK) and said.splitlines()[-1] == "landscape: expected less"
    monkeypatch.undo()
    assert cli.main(["train", "no/such/scene", "--debug"]) == 2
    assert capsys.readouterr().err.startswith(TRACEBACK)


@pytest.mark.parametrize("evil", ["\x1b[2J", "\x1b]0;x\x07", "\x9b2J", "\x08\x7f"])
def test_what_a_terminal_obeys_is_never_printed(capsys, evil):
    console, table = Console(), Table("view")
    table.add_row(escape(f"a{evil}.png"))
    console.print(table, f"a{evil}.png", Text(f"a{evil}.png"))
    say(f"a{evil}.png")
    for error in (InputError(f"got a{evil}.png"), FileNotFoundError(2, "No such file", f"a{evil}.png")):
        report(error, [])
    said = "".join(capsys.readouterr())
    assert said.count(".png") == 6 and not any(each in said for each in "\x1b\x07\x08\x7f\x9b")


@pytest.mark.parametrize(
    ("name", "value"),
    [("NUMBA_NUM_THREADS", "0"), ("NUMBA_NUM_THREADS", "-1"), ("NUMBA_DISABLE_JIT", "1"), ("NUMBA_OPT", "0")],
)
def test_settings_with_which_nothing_or_something_else_compiles_are_refused(monkeypatch, capsys, name, value):
    monkeypatch.setenv(name, value)
    assert cli.main(["probe", "nowhere"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert name in line and value in line and line.endswith("; unset it")


def test_settings_of_numba_in_the_current_folder_are_refused(monkeypatch, capsys, tmp_path):
    (tmp_path / ".numba_config.yaml").write_text("cache_dir: theirs")
    monkeypatch.chdir(tmp_path)
    assert cli.main(["probe", "nowhere"]) == 2 and ".numba_config.yaml" in capsys.readouterr().err

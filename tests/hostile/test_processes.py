"""Commands as processes: signals, full disks, folders that cannot be written, no home, two at work on one folder."""

import os
import re
import resource
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import pytest

from analysis.commands.cli import main
from landscape.errors import InputError
from splat.model.untrusted import beside, locked
from splat.training.checkpoint import load_checkpoint
from tests.forks import Program
from tests.waiting import PATIENCE, waits_for

ROOT = Path(__file__).parents[2]
COMMAND = [sys.executable, "-m", "analysis.commands.cli"]
LONG = ["--iterations", "100000", "--checkpoint-every", "1000000", "--log-every", "1"]


@pytest.fixture(scope="session")
def scene(original) -> Path:
    return Path(shutil.copytree(original, original.with_name("still [v2]")))


@pytest.fixture(scope="session")
def run(scene) -> Path:
    out = scene.with_name("run")
    assert main(["train", str(scene), "--out", str(out), "--iterations", "6"]) == 0
    return out


def started(words: list[str], command: Sequence[str] = COMMAND, **settings) -> subprocess.Popen[str]:
    """A program that Python begins."""
    pipe = subprocess.PIPE
    return subprocess.Popen([*command, *words], cwd=ROOT, stdout=pipe, stderr=pipe, text=True, **settings)


def forked(words: list[str], **settings) -> Program:
    """A command that has its libraries imported as it begins."""
    return Program([*COMMAND, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, **settings)


def stepped(run: Path) -> bool:
    """Whether a training has made a step: below the names and the row of its start."""
    return (run / "train.csv").exists() and (run / "train.csv").read_text().count("\n") > 2


def hidden(folder: Path) -> list[str]:
    return [path.name for path in folder.iterdir() if path.name.startswith(".")]


@pytest.mark.parametrize("kind", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_a_training_that_a_signal_ends_saves_and_says_how_to_continue(scene, tmp_path, kind):
    out = tmp_path / "x[v2]"
    begin = started if kind == signal.SIGTERM else forked
    process = begin(["train", str(scene), "--out", str(out), *LONG])
    waits_for(lambda: stepped(out), process)
    process.send_signal(kind)
    said = process.communicate(timeout=PATIENCE)[1]
    assert process.returncode == 128 + kind, said
    assert f"'{out}'" in said and "Aborted at" not in said and "Traceback" not in said
    assert load_checkpoint(out / "checkpoint.pt").training.step > 0 and hidden(tmp_path) == hidden(out) == []


@pytest.mark.parametrize("words", [["probe", "--quick"], ["slice", "--points", "31", "--all-points"]])
def test_what_a_signal_ends_keeps_what_it_found_and_goes_on_from_there(run, tmp_path, words):
    out = tmp_path / "record"
    command = [words[0], str(run / "checkpoint.pt"), "--out", str(out), *words[1:]]
    process = forked(command)
    waits_for(lambda: any((tmp_path / ".record.unfinished").rglob("[!.]*.[mn]*")), process)
    process.terminate()
    said = process.communicate(timeout=PATIENCE)[1]
    assert process.returncode == 143 and said.endswith("landscape: interrupted by SIGTERM\n"), said
    assert "Aborted at" not in said and "Traceback" not in said and shlex.join(command) in said
    assert [path.name for path in tmp_path.iterdir()] == [".record.unfinished"]
    again = forked(command)
    said = again.communicate(timeout=PATIENCE)[1]
    assert again.returncode == 0 and (words[0] == "slice" or "kept from before" in said), said
    assert [path.name for path in tmp_path.iterdir()] == ["record"]


def test_a_probe_that_a_signal_ends_as_it_begins_leaves_nothing(run, tmp_path):
    out = tmp_path / "probe"
    process = started(["probe", str(run / "checkpoint.pt"), "--out", str(out)])
    waits_for(beside(out).exists, process)
    process.terminate()
    said = process.communicate(timeout=PATIENCE)[1]
    assert process.returncode == 143 and said.endswith("landscape: interrupted by SIGTERM\n"), said
    assert "Aborted at" not in said and list(tmp_path.iterdir()) == []


def test_pictures_are_written_whichever_library_was_imported_first():
    program = (
        "import splat.scenes, io, zlib\nfrom PIL import Image\nfile = io.BytesIO()\n"
        "Image.new('RGB', (50, 50)).save(file, 'png')\nimage = Image.open(file)\nimage.load()\n"
        "print(image.size, len(zlib.decompress(zlib.compress(bytes(10**6)))))"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE)
    assert (done.stdout, done.stderr) == ("(50, 50) 1000000\n", "")


def test_a_second_command_on_a_folder_is_refused_and_a_killed_one_holds_nothing(tmp_path):
    path = beside(tmp_path / "run")
    program = "import sys, time\nfrom pathlib import Path\nfrom splat.model.untrusted import locked\n"
    program += f"with locked(Path(sys.argv[1]), 'no other'):\n    print('held', flush=True)\n    time.sleep({PATIENCE})"
    with subprocess.Popen([sys.executable, "-c", program, str(path)], cwd=ROOT, stdout=subprocess.PIPE) as other:
        assert other.stdout is not None and other.stdout.readline() == b"held\n"
        with (
            pytest.raises(InputError, match="expected no other command, got another at work"),
            locked(path, "no other command"),
        ):
            pass
        assert path.exists()
        other.kill()
    with locked(path, "no other command"):
        assert path.exists()
    assert not path.exists()


def test_of_two_trainings_in_one_folder_one_is_refused_in_a_sentence(scene, tmp_path):
    out = tmp_path / "run"
    first = forked(["train", str(scene), "--out", str(out), *LONG])
    waits_for(lambda: stepped(out), first)
    second = forked(["train", str(scene), "--out", str(out), *LONG, "--resume"])
    said = second.communicate(timeout=PATIENCE)[1]
    assert second.returncode == 2 and "no other training" in said and said.count("landscape:") == 1
    first.terminate()
    first.communicate(timeout=PATIENCE)
    assert first.returncode == 143 and load_checkpoint(out / "checkpoint.pt").training.step > 0


@pytest.mark.parametrize("word", ["probe", "slice"])
def test_a_folder_that_is_taken_or_cannot_be_written_is_known_at_once(run, tmp_path, capsys, word):
    command = [word, str(run / "checkpoint.pt"), "--out"]
    with locked(beside(tmp_path / "record"), "no other"):
        assert main([*command, str(tmp_path / "record")]) == 2
    assert main([*command, "/proc/self/record"]) == 2  # where not even root may write
    said = capsys.readouterr().err
    assert "got another at work" in said and "linearise" not in said
    assert re.search(r"cannot write in /proc/\d+: No such file or directory; choose another --out", said), said
    assert main([word, str(tmp_path / "none/checkpoint.pt")]) == 2 and list(tmp_path.iterdir()) == []


def limited(size: int) -> Callable[[], None]:
    return lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))


def test_a_full_disk_leaves_what_was_there_and_names_the_file(scene, run, tmp_path):
    done = forked(["train", str(scene), "--out", str(tmp_path / "new")], limit=4096)
    said = done.communicate(timeout=PATIENCE)[1]
    assert done.returncode == 74 and str(tmp_path) in said and "Traceback" not in said, said
    quick = ["probe", str(run / "checkpoint.pt"), "--quick", "--out"]
    assert main([*quick, str(run / "first")]) == 0  # compiles what is not yet
    done = forked([*quick, str(tmp_path / "probe")], limit=8192)
    said = done.communicate(timeout=PATIENCE)[1]
    assert done.returncode == 74 and str(tmp_path / ".probe.unfinished/") in said and "Traceback" not in said, said
    assert [path.name for path in tmp_path.iterdir()] == [".probe.unfinished"]  # from where it goes on


def test_without_a_home_or_a_folder_beside_the_code_kernels_are_kept_with_temporary_files(tmp_path, monkeypatch):
    from splat.backend.cpu import kernel_cache

    monkeypatch.setattr(kernel_cache, "PACKAGE", kernel_cache.PACKAGE)
    for home in (None, str(tmp_path / "none")):
        monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
        monkeypatch.delenv("HOME", raising=False) if home is None else monkeypatch.setenv("HOME", home)
        monkeypatch.setattr(kernel_cache, "gettempdir", lambda: str(tmp_path))
        assert kernel_cache._places()[-1] == tmp_path / f"splat-landscape-{os.getuid()}"
    # no folder for temporary files can be written, as under `ulimit -f 0`
    monkeypatch.setattr(kernel_cache, "gettempdir", partial(open, "/none/of/them"))
    assert kernel_cache._places() == [kernel_cache.PACKAGE / "__pycache__"]
    file = tmp_path / "file"
    file.write_text("")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(file))
    with pytest.raises(InputError, match="name one with NUMBA_CACHE_DIR"):
        kernel_cache.kernel_folder(256)


def test_of_two_that_need_a_kernel_one_compiles_and_a_cut_file_is_compiled_anew(tmp_path):
    (tmp_path / "small.py").write_text(
        "import time\nfrom numba.core import event\n"
        "from splat.backend.cpu import simd\nfrom splat.backend.cpu.jit import kernel\n"
        "class Slow(event.Listener):\n    on_end = on_start = lambda *_: time.sleep(0.5)\n"
        "@kernel\ndef twice(x):\n    return 2 * x\n"
        "event.register('numba:compile', Slow())\nprint(twice(4.0), len(twice.stats.cache_misses))\n"
    )
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": str(ROOT)}
    begun = partial(started, [str(tmp_path / "small.py")], [sys.executable], env=environment)
    said = begun(preexec_fn=limited(100)).communicate(timeout=PATIENCE)[1]
    assert "File too large" in said and str(tmp_path / "cache") in said.splitlines()[-1]
    cold = [begun(), begun()]
    assert sorted(process.communicate(timeout=PATIENCE) for process in cold) == [("8.0 0\n", ""), ("8.0 1\n", "")]
    for suffix in ("nbi", "nbc"):
        for file in (tmp_path / "cache").rglob(f"small.twice-*.{suffix}"):
            file.write_bytes(file.read_bytes()[:40])
        assert begun().communicate(timeout=PATIENCE) == ("8.0 1\n", "")


@pytest.mark.parametrize("words", [["train", "--help"], ["trajectory", "nowhere"]])
def test_output_that_nobody_reads_is_no_error(words):
    command = " ".join([*COMMAND, *words])
    for pipe in ("| true; exit ${PIPESTATUS[0]}", ">&-"):
        call, buffered = ["bash", "-c", f"{command} {pipe}"], {**os.environ, "PYTHONUNBUFFERED": ""}
        done = subprocess.run(call, cwd=ROOT, capture_output=True, text=True, env=buffered)
        assert done.returncode in ((0, 141) if words[1] == "--help" else (2,)) and "Traceback" not in done.stderr

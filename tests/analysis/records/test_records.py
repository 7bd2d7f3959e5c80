import json
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest

from analysis.records.findings import findings, of_slice
from analysis.records.json_files import plain
from analysis.records.records import ProbeRecord, SliceRecord, read_record, record_folder, write_data
from analysis.records.run_files import read_trajectory
from analysis.records.tables import family_table, number_rows
from tests import recorded
from tests.figures.test_trajectory_figure import rows
from tests.recorded import probe_of, synthetic
from tests.refusals import refused


def written(folder, data=None, arrays=None):
    plain_data, plain_arrays = synthetic()
    return recorded.written(folder, data or plain_data, plain_arrays if arrays is None else arrays).folder


def holds(found, expected) -> bool:
    """Whether what is found has all that is expected, and perhaps defaults beside it."""
    if isinstance(expected, dict):
        return all(key in found and holds(found[key], value) for key, value in expected.items())
    if isinstance(expected, list):
        return len(found) == len(expected) and all(map(holds, found, expected))
    return found == expected


def leftovers(parent):
    return [path.name for path in parent.iterdir() if path.name.startswith(".")]


def test_a_record_comes_back_as_it_was_written(tmp_path):
    data, arrays = synthetic()
    record = read_record(written(tmp_path / "run" / "probe", data, arrays))
    assert holds(plain(record.data), data)
    for group, names in arrays.items():
        for name, array in names.items():
            np.testing.assert_array_equal(record.arrays[group][name], array)
            assert record.arrays[group][name].dtype == array.dtype
    assert leftovers(tmp_path / "run") == []


@pytest.mark.parametrize("number", [1e-12, -1e9, 5e-324, 1.7976931348623157e308, 0.1, math.inf, -math.inf])
def test_a_number_of_any_size_survives_exactly(tmp_path, number):
    data, arrays = synthetic()
    record = recorded.written(tmp_path / "probe", data, arrays)
    trace = record.data.traces["means"]
    trace.value, trace.low, trace.high = np.float64(number), None, None
    record.data.counts.products = np.int64(7)
    write_data(record.folder, record.data)
    record = read_record(record.folder, ProbeRecord)
    assert record.data.traces["means"].value == number
    assert record.data.counts.products == 7


def test_data_are_written_anew_beside_the_arrays_that_are_there(tmp_path):
    data, arrays = synthetic()
    folder = written(tmp_path / "probe", data, arrays)
    files = {path.name: path.stat().st_mtime_ns for path in folder.glob("*.npz")}
    record = read_record(folder)
    record.data.notes = ["later"]
    write_data(folder, record.data)
    record = read_record(folder)
    assert record.data.notes == ["later"] and set(record.arrays) == set(arrays)
    assert {path.name: path.stat().st_mtime_ns for path in folder.glob("*.npz")} == files != {}


def test_what_is_not_finite_is_written_as_text_in_strict_json(tmp_path):
    data, arrays = synthetic()
    data["traces"]["sh"] |= {"value": math.nan, "standard_error": math.inf, "low": -math.inf}
    folder = written(tmp_path / "probe", data, arrays)

    def refuse(constant):
        raise AssertionError(f"{constant} is not JSON")

    raw = json.loads((folder / "probe.json").read_text(encoding="utf-8"), parse_constant=refuse)["traces"]["sh"]
    assert (raw["value"], raw["standard_error"], raw["low"]) == ("NaN", "Infinity", "-Infinity")
    read = read_record(folder, ProbeRecord).data.traces["sh"]
    assert read.value is not None and math.isnan(read.value)
    assert read.standard_error == math.inf and read.low == -math.inf


def test_a_record_may_have_no_slice_and_no_arrays(tmp_path):
    data, _ = synthetic()
    record = read_record(written(tmp_path / "probe", data | {"slice": None}, {}))
    assert record.data.slice is None and record.arrays == {}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda d: d["traces"]["means"].pop("standard_error"),
            r"missing required field `standard_error` - at `\$.traces\[...\]`",
        ),
        (lambda d: d["eigenvalues"].pop("min"), r"missing required field `min` - at `\$.eigenvalues`"),
        (lambda d: d.pop("checks"), "missing required field `checks`"),
        (lambda d: d["slice"]["directions"][1].pop("unit"), r"field `unit` - at `\$.slice.directions\[1\]`"),
        (lambda d: d["slice"].pop("center_loss"), r"field `center_loss` - at `\$.slice`"),
        (
            lambda d: d["slice"]["directions"].__setitem__(0, None),
            r"`object`, got `null` - at `\$.slice.directions\[0\]`",
        ),
        (lambda d: d["slice"].update(directions=2), r"`array`, got `int` - at `\$.slice.directions`"),
        (lambda d: d["slice"]["directions"].pop(), "expected 2 slice.directions, got 1"),
        (lambda d: d.update(slice=3), r"got `int` - at `\$.slice`"),
        (lambda d: d["counts"].update(visible_gaussians=None), r"`int`, got `null` - at `\$.counts.visible_gaussians`"),
        (lambda d: d["counts"].update(views=-1), r"at `\$.counts.views`"),
        (lambda d: d["slice"].update(crossed_points="many"), r"`int`, got `str` - at `\$.slice.crossed_points`"),
        (lambda d: d.update(notes=None), r"`array`, got `null` - at `\$.notes`"),
        (lambda d: d.update(notes=[3]), r"`str`, got `int` - at `\$.notes\[0\]`"),
        (lambda d: d["notes"].append("NaN"), r"`str`, got `float` - at `\$.notes\[1\]`"),
        (lambda d: d["anisotropy"].update(negative_ratio=3.0), r"got `float` - at `\$.anisotropy.negative_ratio`"),
        (lambda d: d["traces"]["quats"].update(value=[1.0]), r"got `array` - at `\$.traces\[...\].value`"),
        (lambda d: d["traces"]["sh"].update(sign="?"), r"invalid enum value .* - at `\$.traces\[...\].sign`"),
        (lambda d: d["timing"].update(load="long"), r"`float`, got `str` - at `\$.timing\[...\]`"),
        (lambda d: d.update(arrays={"spectrum": 3}), r"`object`, got `int` - at `\$.arrays\[...\]`"),
        (lambda d: d["arrays"]["spectrum"].pop("residuals"), r"residuals of shape \[\] instead of \[k\]"),
        (lambda d: d["arrays"]["slice"].pop("y"), "loss of shape"),
        (lambda d: d["slice"].update(resolved=False), "`evaluated_points` of a plane that is not resolved, got none"),
    ],
)
def test_a_changed_record_is_refused_by_file_and_key(tmp_path, change, words):
    path = written(tmp_path / "probe") / "probe.json"
    raw = json.loads(path.read_text(encoding="utf-8"))
    change(raw)
    path.write_text(json.dumps(raw), encoding="utf-8")
    with pytest.raises(ValueError, match=f"(?s){words}.*; probe again") as refused:
        read_record(tmp_path / "probe")
    assert str(tmp_path) in str(refused.value) and "\n" not in str(refused.value)


@pytest.mark.parametrize(("key", "value"), [("value", "high"), ("value", np.zeros(3)), ("method", 3)])
def test_what_could_not_be_read_again_is_not_written(tmp_path, key, value):
    record = probe_of(synthetic()[0])
    setattr(record.traces["quats"], key, value)
    with pytest.raises((ValueError, TypeError)), record_folder(tmp_path / "probe") as partial:
        write_data(partial, record)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("array", "words"),
    [
        (np.zeros((21, 17), complex), "loss of complex128 instead of floating values"),
        (np.array([["a"] * 17] * 21), "loss of <U1 instead of floating values"),
        (np.zeros((17, 21)), r"loss of shape \[17, 21\] instead of \[21, 17\]"),
        (None, "no loss"),
    ],
)
def test_a_changed_array_is_refused_by_file_and_name(tmp_path, array, words):
    folder, arrays = written(tmp_path / "probe"), synthetic()[1]["slice"]
    arrays |= {"loss": array}
    known: dict[str, Any] = {name: values for name, values in arrays.items() if values is not None}
    np.savez(folder / "slice.npz", **known)
    refused(rf"slice\.npz, got {words}.*; probe again", read_record, folder)


def test_residuals_below_0_are_refused(tmp_path):
    folder, arrays = written(tmp_path / "probe"), synthetic()[1]["spectrum"]
    known: dict[str, Any] = arrays | {"residuals": -1.0 - arrays["residuals"]}
    np.savez(folder / "spectrum.npz", **known)
    refused(r"spectrum\.npz, got residuals below 0", read_record, folder)


def test_steps_that_do_not_increase_are_refused(tmp_path):
    data, arrays = synthetic()
    arrays["slice"]["x"][3] = math.nan
    refused("steps x that do not increase", written, tmp_path / "probe", data, arrays)


def test_arrays_of_objects_are_refused(tmp_path):
    data, _ = synthetic()
    refused(r"slice\.x", written, tmp_path / "probe", data, {"slice": {"x": np.array([None, 1.0])}})


def test_a_failing_block_leaves_the_old_record_and_no_trace(tmp_path):
    folder = written(tmp_path / "probe")
    before = (folder / "probe.json").read_bytes()

    def interrupted():
        with record_folder(folder) as partial:
            (partial / "probe.json").write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert (folder / "probe.json").read_bytes() == before
    assert leftovers(tmp_path) == []


def test_a_new_record_replaces_all_of_the_old_one(tmp_path):
    folder = written(tmp_path / "probe")
    (folder / "of_the_old_one.png").touch()
    data, _ = synthetic(seed=5)
    written(folder, data, {})
    assert sorted(path.name for path in folder.iterdir()) == ["probe.json"]
    assert read_record(folder).data.provenance.seed == 5
    assert leftovers(tmp_path) == []


KILLED = """
import sys, time
sys.path[:0] = sys.argv[2:]
from analysis.records.records import record_folder, write_record
from tests.recorded import probe_of, synthetic
data, arrays = synthetic(seed=9)
with record_folder(sys.argv[1]) as partial:
    write_record(partial, probe_of(data), arrays)
    (partial / "report.html").write_text("half a page")
    print("written", flush=True)
    time.sleep(60)
"""


def test_a_process_killed_while_it_writes_leaves_the_old_record_whole(tmp_path, request):
    folder = written(tmp_path / "probe")
    command = [sys.executable, "-c", KILLED, str(folder), str(request.config.rootpath)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None and process.stdout.readline() == "written\n"
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    assert read_record(folder).data.provenance.seed == 0
    assert not (folder / "report.html").exists()
    (abandoned,) = tmp_path.glob(".probe.partial-*")
    long_ago = time.time() - 7200
    os.utime(abandoned, (long_ago, long_ago))
    written(folder)
    assert leftovers(tmp_path) == []


def test_a_replacement_interrupted_between_its_two_renames_is_mended(tmp_path):
    folder = written(tmp_path / "probe")
    folder.rename(tmp_path / ".probe.previous")
    refused(r"interrupted; rename .*\.probe\.previous", read_record, folder, error=FileNotFoundError)
    with pytest.raises(RuntimeError), record_folder(folder):
        raise RuntimeError
    assert read_record(folder).data.provenance.seed == 0
    assert leftovers(tmp_path) == []


def test_a_folder_of_something_else_is_never_replaced(tmp_path):
    (tmp_path / "thesis.tex").touch()
    refused(r"without probe\.json", written, tmp_path)
    refused("got the file", written, tmp_path / "thesis.tex")
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_what_is_missing_is_said_with_what_to_do(tmp_path):
    refused("does not exist; run `landscape probe", read_record, tmp_path / "nowhere", error=FileNotFoundError)
    refused("which has none", read_record, tmp_path, error=FileNotFoundError)
    written(tmp_path / "probe")
    refused(r"which is a run; name .*probe", read_record, tmp_path, error=FileNotFoundError)
    assert read_record(tmp_path / "probe" / "probe.json").data.counts.views == 3
    (tmp_path / "probe" / "slice.npz").unlink()
    refused(r"slice\.npz.*probe again", read_record, tmp_path / "probe", error=FileNotFoundError)


@pytest.mark.parametrize("name", ["probe.json", "slice.npz", "traces.npz"])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.9])
def test_a_truncated_file_is_named(tmp_path, name, share):
    path = written(tmp_path / "probe") / name
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    refused(rf"{name}.*probe again", read_record, path.parent)


def test_an_array_of_another_shape_than_recorded_is_named(tmp_path):
    folder = written(tmp_path / "probe")
    np.savez(folder / "traces.npz", means=np.zeros(2))
    refused(r"means of shape \[2\] instead of \[16\]", read_record, folder)


@pytest.mark.parametrize("foreign", ["[]", "{}", '{"format": 3}', '{"format": {"name": "other", "version": 1}}', "3"])
def test_json_of_something_else_is_refused(tmp_path, foreign):
    (tmp_path / "probe.json").write_text(foreign)
    refused("expected a record of `landscape probe`", read_record, tmp_path)


def test_a_newer_format_is_refused_with_what_to_do(tmp_path):
    folder = written(tmp_path / "probe")
    raw = json.loads((folder / "probe.json").read_text(encoding="utf-8"))
    raw["format"]["version"] = ProbeRecord.FORMAT.version + 1
    (folder / "probe.json").write_text(json.dumps(raw))
    refused(r"expected a record of `landscape probe` in .*; probe again", read_record, folder)


def test_records_reports_and_figures_need_no_torch():
    program = "import sys, analysis.records.page.report, figures.make_all; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0


EXAMPLES = Path(__file__).parent / "examples"  # records without their arrays: a probe with families, and a slice


def attempted(folder):
    """The record, or what is said of it."""
    try:
        return read_record(folder), ""
    except ValueError as error:
        return None, str(error)


NOTHING = object()
WRONG = (None, -1, 0, 3.5, 1e300, 2**70, True, "NaN", "-Infinity", "text", [], {}, [None], {"a": 1}, NOTHING)


def changed(raw, random):
    """Another value, or none, in a random place of JSON."""
    place, path = raw, []
    while isinstance(place, dict | list) and len(place) and (not path or random.random() < 0.85):
        path.append((place, random.choice(list(place) if isinstance(place, dict) else list(range(len(place))))))
        place = path[-1][0][path[-1][1]]
    owner, key = path[-1]
    wrong = WRONG[random.randrange(len(WRONG))]
    if wrong is NOTHING:
        del owner[key]
    else:
        owner[key] = wrong
    return [key for _, key in path]


@pytest.mark.parametrize("name", ["probe", "slice"])
def test_a_record_changed_anywhere_is_read_or_refused_in_a_sentence(tmp_path, name):
    """What is read has all its sentences and tables."""
    random, read = Random(0), 0
    text = (EXAMPLES / f"{name}.json").read_text(encoding="utf-8")
    for _ in range(1000):
        raw = json.loads(text)
        place = changed(raw, random)
        (tmp_path / f"{name}.json").write_text(json.dumps(raw), encoding="utf-8")
        record, said = attempted(tmp_path)
        if record is None:
            assert f"{name} again" in said and str(tmp_path) in said and "\n" not in said, place
            continue
        read += 1
        if isinstance(record.data, ProbeRecord):
            said = findings(record.data)
            assert said and number_rows(record.data) and family_table(record.data).row_count is not None, place
        else:
            assert isinstance(record.data, SliceRecord)
            assert of_slice(record.data.slice, record.data.provenance) is not None
    assert 100 < read < 900


@pytest.mark.parametrize("name", ["slice.npz", "spectrum.npz", "traces.npz"])
def test_an_archive_with_changed_bytes_is_read_or_refused_in_a_sentence(tmp_path, name):
    random, path = Random(1), written(tmp_path / "probe") / name
    whole = path.read_bytes()
    for _ in range(150):
        content = bytearray(whole)
        for _ in range(random.choice([1, 3, 30])):
            content[random.randrange(len(content))] = random.randrange(256)
        path.write_bytes(content)
        record, said = attempted(path.parent)
        assert record is not None or (str(path) in said and "probe again" in said), said


def test_damaged_trajectories_are_refused_by_file_and_column(tmp_path):
    rows().to_csv(path := tmp_path / "trajectory.csv", index=False)
    assert len(read_trajectory(path)) == len(rows())
    for change, words in (
        (lambda t: t.drop(columns="trace_sh_low"), "got no column trace_sh_low"),
        (lambda t: t.assign(lambda_max="steep"), "expected a number as lambda_max in .*, got 'steep' in row 1"),
        (lambda t: t.assign(step=None), "expected a number as step in"),
        (lambda t: t.assign(state="lost"), "expected whole or coarse or skipped as state in .*, got 'lost' in row 1"),
        (lambda t: t.head(0)[[]], "No columns"),
    ):
        change(rows()).to_csv(path, index=False)
        refused(words, read_trajectory, path)

import json
import math
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from analysis.records.records import FORMAT, read_record, record_folder, write_data, write_record
from tests.recorded import synthetic


def written(folder, data=None, arrays=None):
    plain_data, plain_arrays = synthetic()
    with record_folder(folder) as partial:
        write_record(partial, data or plain_data, plain_arrays if arrays is None else arrays)
    return folder


def leftovers(parent):
    return [path.name for path in parent.iterdir() if path.name.startswith(".")]


def test_a_record_comes_back_as_it_was_written(tmp_path):
    data, arrays = synthetic()
    record = read_record(written(tmp_path / "run" / "probe", data, arrays))
    assert {key: record.data[key] for key in data} == data
    for group, names in arrays.items():
        for name, array in names.items():
            np.testing.assert_array_equal(record.arrays[group][name], array)
            assert record.arrays[group][name].dtype == array.dtype
    assert leftovers(tmp_path / "run") == []


@pytest.mark.parametrize("number", [1e-12, -1e9, 5e-324, 1.7976931348623157e308, 0.1, math.inf, -math.inf])
def test_a_number_of_any_size_survives_exactly(tmp_path, number):
    data, arrays = synthetic()
    data["traces"]["means"]["value"] = np.float64(number)
    data["counts"]["gaussians"] = np.int64(7)
    record = read_record(written(tmp_path / "probe", data, arrays))
    assert record.data["traces"]["means"]["value"] == number
    assert record.data["counts"]["gaussians"] == 7


def test_data_are_written_anew_beside_the_arrays_that_are_there(tmp_path):
    data, arrays = synthetic()
    folder = written(tmp_path / "probe", data, arrays)
    files = {path.name: path.stat().st_mtime_ns for path in folder.glob("*.npz")}
    write_data(folder, {**data, "notes": ["later"]}, arrays)
    record = read_record(folder)
    assert record.data["notes"] == ["later"] and set(record.arrays) == set(arrays)
    assert {path.name: path.stat().st_mtime_ns for path in folder.glob("*.npz")} == files != {}


def test_what_is_not_finite_is_written_as_text_in_strict_json(tmp_path):
    data, arrays = synthetic()
    data["traces"]["sh"] |= {"value": math.nan, "standard_error": math.inf, "low": -math.inf}
    folder = written(tmp_path / "probe", data, arrays)

    def refuse(constant):
        raise AssertionError(f"{constant} is not JSON")

    raw = json.loads((folder / "probe.json").read_text(encoding="utf-8"), parse_constant=refuse)["traces"]["sh"]
    assert (raw["value"], raw["standard_error"], raw["low"]) == ("NaN", "Infinity", "-Infinity")
    read = read_record(folder).data["traces"]["sh"]
    assert math.isnan(read["value"]) and read["standard_error"] == math.inf and read["low"] == -math.inf


def test_a_record_may_have_no_slice_and_no_arrays(tmp_path):
    data, _ = synthetic()
    record = read_record(written(tmp_path / "probe", data | {"slice": None}, {}))
    assert record.data["slice"] is None and record.arrays == {}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda d: d["traces"]["means"].pop("standard_error"), "traces.means.standard_error"),
        (lambda d: d["eigenvalues"].pop("min"), "eigenvalues.min"),
        (lambda d: d.pop("checks"), '"checks"'),
        (lambda d: d["slice"]["directions"][1].pop("unit"), "slice.directions.unit"),
        (lambda d: d["slice"].pop("center_loss"), "center_loss"),
        (lambda d: d["slice"]["directions"].__setitem__(0, None), "slice.directions"),
        (lambda d: d["slice"].update(directions=2), "2 .directions"),
        (lambda d: d.update(slice=3), '"slice"'),
        (lambda d: d["counts"].update(visible_gaussians=None), "counts.visible_gaussians"),
        (lambda d: d["slice"].update(points=None), "slice.points"),
        (lambda d: d["slice"].update(crossed_points="many"), "slice.crossed_points"),
        (lambda d: d.update(notes=None), '"notes"'),
        (lambda d: d.update(notes=[3]), '"notes"'),
        (lambda d: d["anisotropy"].update(saddle=3.0), "anisotropy.saddle"),
        (lambda d: d["traces"]["quats"].update(value=np.zeros(3)), "traces.quats.value.*npz"),
        (lambda d: d["notes"].append("NaN"), r"notes\[1\]"),
        (lambda d: d["timing"].update({3: 1.0}), "timing"),
    ],
)
def test_data_that_has_no_place_is_refused_by_name_and_nothing_is_written(tmp_path, change, words):
    data, arrays = synthetic()
    change(data)
    with pytest.raises(ValueError, match=words):
        written(tmp_path / "probe", data, arrays)
    assert list(tmp_path.iterdir()) == []


def test_arrays_of_objects_are_refused(tmp_path):
    data, _ = synthetic()
    with pytest.raises(ValueError, match=r"slice\.x"):
        written(tmp_path / "probe", data, {"slice": {"x": np.array([None, 1.0])}})


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
    assert read_record(folder).data["provenance"]["seed"] == 5
    assert leftovers(tmp_path) == []


KILLED = """
import sys, time
sys.path[:0] = sys.argv[2:]
from analysis.records import record_folder, write_record
from tests.recorded import synthetic
with record_folder(sys.argv[1]) as partial:
    write_record(partial, *synthetic(seed=9))
    (partial / "report.html").write_text("half a page")
    print("written", flush=True)
    time.sleep(60)
"""


def test_a_process_killed_while_it_writes_leaves_the_old_record_whole(tmp_path, request):
    folder = written(tmp_path / "probe")
    process = subprocess.Popen(
        [sys.executable, "-c", KILLED, str(folder), str(request.config.rootpath)], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None and process.stdout.readline() == "written\n"
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    assert read_record(folder).data["provenance"]["seed"] == 0
    assert not (folder / "report.html").exists()
    (abandoned,) = tmp_path.glob(".probe.partial-*")
    long_ago = time.time() - 7200
    os.utime(abandoned, (long_ago, long_ago))
    written(folder)
    assert leftovers(tmp_path) == []


def test_a_replacement_interrupted_between_its_two_renames_is_mended(tmp_path):
    folder = written(tmp_path / "probe")
    folder.rename(tmp_path / ".probe.previous")
    with pytest.raises(FileNotFoundError, match=r"interrupted; rename .*\.probe\.previous"):
        read_record(folder)
    with pytest.raises(RuntimeError), record_folder(folder):
        raise RuntimeError
    assert read_record(folder).data["provenance"]["seed"] == 0
    assert leftovers(tmp_path) == []


def test_a_folder_of_something_else_is_never_replaced(tmp_path):
    (tmp_path / "thesis.tex").touch()
    with pytest.raises(ValueError, match=r"without probe\.json"):
        written(tmp_path)
    with pytest.raises(ValueError, match="got the file"):
        written(tmp_path / "thesis.tex")
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_what_is_missing_is_said_with_what_to_do(tmp_path):
    with pytest.raises(FileNotFoundError, match="does not exist; run `landscape probe"):
        read_record(tmp_path / "nowhere")
    with pytest.raises(FileNotFoundError, match="which has none"):
        read_record(tmp_path)
    written(tmp_path / "probe")
    with pytest.raises(FileNotFoundError, match=r"which is a run; name .*probe"):
        read_record(tmp_path)
    assert read_record(tmp_path / "probe" / "probe.json").data["counts"]["views"] == 3
    (tmp_path / "probe" / "slice.npz").unlink()
    with pytest.raises(FileNotFoundError, match=r"slice\.npz.*probe again"):
        read_record(tmp_path / "probe")


@pytest.mark.parametrize("name", ["probe.json", "slice.npz", "traces.npz"])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.9])
def test_a_truncated_file_is_named(tmp_path, name, share):
    path = written(tmp_path / "probe") / name
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(ValueError, match=rf"{name}.*probe again"):
        read_record(path.parent)


def test_an_array_of_another_shape_than_recorded_is_named(tmp_path):
    folder = written(tmp_path / "probe")
    np.savez(folder / "traces.npz", means=np.zeros(2))
    with pytest.raises(ValueError, match=r"expected means of shape \[16\].*got \[2\]"):
        read_record(folder)


@pytest.mark.parametrize("foreign", ["[]", "{}", '{"format": 3}', '{"format": {"name": "other", "version": 1}}', "3"])
def test_json_of_something_else_is_refused(tmp_path, foreign):
    (tmp_path / "probe.json").write_text(foreign)
    with pytest.raises(ValueError, match="expected a record of `landscape probe`"):
        read_record(tmp_path)


@pytest.mark.parametrize("shapes", [None, 3, [4]])
def test_arrays_that_are_no_shapes_by_name_are_refused(tmp_path, shapes):
    path = written(tmp_path / "probe") / "probe.json"
    raw = json.loads(path.read_text(encoding="utf-8"))
    path.write_text(json.dumps(raw | {"arrays": raw["arrays"] | {"spectrum": shapes}}), encoding="utf-8")
    with pytest.raises(ValueError, match=r'"arrays\.spectrum".*probe again'):
        read_record(path)


def test_a_newer_format_is_refused_with_what_to_do(tmp_path):
    folder = written(tmp_path / "probe")
    raw = json.loads((folder / "probe.json").read_text(encoding="utf-8"))
    raw["format"]["version"] = int(FORMAT["version"]) + 1
    (folder / "probe.json").write_text(json.dumps(raw))
    with pytest.raises(ValueError, match="got version 2; update"):
        read_record(folder)


def test_records_reports_and_figures_need_no_torch():
    program = "import sys, analysis.records.report, figures.make_all; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0

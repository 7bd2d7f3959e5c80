"""What a record is said to show: sentences, and the summary on a terminal."""

import json
from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console

from analysis.records.findings import findings
from analysis.records.page.summary import summary
from analysis.records.tables import family_table, number_rows
from tests.recorded import depth_section, probe_of, soft, synthetic


def sentences(data, level=None):
    return " | ".join(line.text for line in findings(probe_of(data)) if level in {None, line.level})


def estimated(value: float, error: float) -> dict[str, float]:
    """Another value of a trace, and its interval."""
    return {"value": value, "standard_error": error, "low": value - 2 * error, "high": value + 2 * error}


def step_line(data):
    return next((line for line in summary(probe_of(data), Path()) if line.startswith("a step")), "")


def test_attributes_are_compared_by_the_optimisers_steps_where_their_intervals_are_apart():
    data, _ = synthetic()
    assert step_line(data) == ""  # the record has no steps
    data["steps"] = dict.fromkeys(data["traces"], 0.001)
    data["steps"]["log_scales"] = 0.02
    factor = 400 * data["traces"]["log_scales"]["value"] / data["traces"]["means"]["value"]
    assert f"of the optimiser in scale changes the loss {factor:.2g} times as much as in position" in step_line(data)
    whole, undecided = data["traces"]["log_scales"], "changes the loss most in"
    data["traces"]["log_scales"] = whole | {"views_error": None}  # one of several views was measured
    assert undecided in step_line(data)
    width = 1e3 * whole["value"]  # not even the sign is known
    data["traces"]["log_scales"] = whole | {"value": 0.0, "low": -width, "high": width, "sign": "undetermined"}
    assert undecided in step_line(data)
    data["traces"]["log_scales"] = whole
    data["steps"]["log_scales"] = 7e-3  # the same change as of positions, within the errors
    assert undecided in step_line(data)


def test_attributes_have_no_order_where_an_error_is_not_known():
    """That by the views left out is not, where one of several was measured."""
    data, _ = synthetic()
    data["steps"] = dict.fromkeys(data["traces"], 0.001)
    line = step_line(data)
    assert "in position changes the loss " in line and "times as much as in " in line and ", then " in line
    for trace in data["traces"].values():
        trace["views_error"] = None
    line = step_line(data)
    assert " then " not in line and line.count(" ≈ ") == len(data["traces"]) - 1


def test_a_check_that_failed_leaves_no_number_that_it_puts_in_doubt():
    data, _ = synthetic()
    data["checks"]["finite_difference"] |= {"value": 20.3, "bound": 4.77e-4, "passed": False}
    lines = dict(line.split(maxsplit=1) for line in map(soft, summary(probe_of(data), Path())))
    assert set(lines) == {"scene", "curvature", "checks", "time", "report"}
    assert lines["curvature"] == (
        "the check of finite difference failed, which puts every curvature in doubt: none is told"
    )
    data["checks"]["finite_difference"]["passed"], data["checks"]["round_off"]["passed"] = True, False
    assert "steepest" in {line.split()[0] for line in summary(probe_of(data), Path())}


@pytest.mark.parametrize(
    ("confirmed", "ratio", "said"),
    [
        (True, 1.5, "renders agree within a factor of 2 at 1/2 to 2 × the optimiser's step"),
        (False, -1.5, "not confirmed by renders, by which it is 330 over the optimiser's step: no saddle is claimed"),
        (None, 0.3, "not resolved: round-off hides it in renders at up to 2 × the optimiser's step"),
    ],
)
@pytest.mark.parametrize("wide", [{}, {"wide": (4, -120.0, 14.0)}])
def test_a_negative_end_is_what_renders_say_of_it(confirmed, ratio, said, wide):
    data, _ = synthetic()
    rendered = {"steps": [1e-3, 2e-3, 4e-3], "optimiser_step": 2e-3, "ratios": [ratio] * 3, "errors": [0.3] * 3}
    rendered |= {"confirmed": confirmed} | ({"low": 1e-3, "high": 4e-3} if confirmed else {})
    data["eigenvalues"]["min"] |= {"value": -220.0, "residual": 1e-3, "reason": "tolerance", "renders": rendered}
    data["eigenvalues"]["min"]["carrier"] = {
        "gaussian": 3739, "share": 0.9, "attribute": "quats", "shape": "a needle, 158 : 1 in the picture",
        "random_share": 0.002, "found": 10, **wide,
    }  # fmt: skip
    lines = dict(line.split(maxsplit=1) for line in map(soft, summary(probe_of(data), Path())))
    over = "one training" if not confirmed else "330 over the optimiser's step in renders; one training"
    assert lines["negative"].startswith("−220 (" + over.replace("330", "−330"))
    who = (
        "90% on Gaussian 3,739 (a random direction has at most 0.2% on each), most of it in rotation, a needle, 158 : 1 in "
        "the picture; "
    )
    other = "each of the first 10 eigenvectors from this end lies on at most ten Gaussians"
    other = "number 4 from this end (−120) is the first eigenvector on more than ten Gaussians" if wide else other
    assert lines["negative"].endswith(f"{who}{other}; {said}")
    assert "λ max / λ min" not in str(lines)
    numbers = {name: index.value for name, index in probe_of(data).indices.items()}
    assert (numbers["negative_ratio"] is None) == (numbers["eigenvalue_ratio"] is None) == (confirmed is not True)


@pytest.mark.parametrize("confirmed", [True, False])
def test_kinks_are_told_once_where_they_explain(confirmed):
    data, _ = synthetic()
    rendered = {"steps": [2e-3], "optimiser_step": 2e-3, "ratios": [4.0], "errors": [0.1], "kinks": 666.0}
    end = data["eigenvalues"]["max"] = data["eigenvalues"]["max"] | {"value": 200.0, "reason": "tolerance"}
    end["renders"] = rendered | {"confirmed": confirmed} | ({"low": 2e-3, "high": 2e-3} if confirmed else {})
    line = dict(line.split(maxsplit=1) for line in map(soft, summary(probe_of(data), Path())))["steepest"]
    beside = "(800 over the optimiser's step in renders; kinks of L1 add about 670 at short steps; one training)"
    because = (
        "(800 over the optimiser's step in renders; one training); not confirmed by renders, as kinks of L1, which"
    )
    assert line.count("kinks") == 1 and (beside if confirmed else because) in line


@pytest.mark.parametrize(("low", "residual", "undecided"), [(-220.0, 3.0, False), (-2.0, 3.0, True), (5.0, 3.0, False)])
def test_the_findings_say_whether_the_residuals_decide_that_the_hessian_is_indefinite(low, residual, undecided):
    data, _ = synthetic()
    data["eigenvalues"]["min"] |= {"value": low, "residual": residual}
    assert ("is not decided by the residuals" in sentences(data)) == undecided


def test_the_findings_say_where_a_budget_ended_the_search_for_an_end():
    data, _ = synthetic()
    data["eigenvalues"]["min"] |= {"reason": "tolerance"}
    assert "farther out" not in sentences(data)
    data["eigenvalues"]["min"] |= {"reason": "matvec budget"}
    assert "The search for the smallest eigenvalue ended at its matvec budget" in sentences(data, "caution")
    data["eigenvalues"]["max"] |= {"reason": "matvec budget"}
    assert "The search for the largest eigenvalue ended at its matvec budget" in sentences(data, "caution")


def test_the_findings_says_what_was_skipped_and_what_could_not_run():
    said = sentences(synthetic()[0])
    assert "326 of the slice's 357 rendered points" in said
    assert "finite difference could not run (every direction crosses a sort)" in said


def test_the_findings_say_how_much_of_the_slice_is_interpolated():
    data, _ = synthetic()
    data["slice"] |= {"evaluated_points": 80, "crossed_points": 70, "interpolation_error": 0.004, "holdout_points": 30}
    data["slice"] |= {"error_seen": 0.002, "tolerance": 0.01}
    said = sentences(data)
    assert "Of the slice's 357 points 80 are renders" in said
    assert "interpolated, at 30 random points to 0.20%, everywhere to 0.40% of the range of the loss." in said
    assert "70 of the slice's 80 rendered points" in said
    data["slice"] |= {"interpolation_error": None, "error_seen": None}
    assert "30 random points without bound" in sentences(data)
    data["slice"]["resolved"] = False
    assert "from 80 of 357 renders, and no surface is drawn; landscape slice" in sentences(data)


def cells(data):
    """(value, what else is known) of every number, by name."""
    return {name: rest for rows in number_rows(probe_of(data)).values() for name, *rest in rows}


def test_needles_have_rows_where_they_are_known():
    data, _ = synthetic()
    assert not {"share of e₁ on needles"} & set(cells(data))
    data["eigenvalues"]["max"]["lives_on"] = {"needles": 0.78, "needle_count": 1, "participation": 1.8}
    found = cells(data)
    assert found["share of e₁ on needles"] == ["78%", "which 1 of the 9,874 Gaussians in sight are"]
    assert found["Gaussians that e₁ is spread over"][0] == "1.8" and "Gaussians that eₘᵢₙ is spread over" not in found


def test_of_depth_only_what_was_determined_has_a_number():
    data, _ = synthetic()
    found = cells(data | {"depth": depth_section(None) | {"rises": []}})
    assert found["depth gradient / lateral"][0] == "–"
    assert not any("rise" in name for name in found)


def test_notes_are_sentences():
    data, _ = synthetic()
    data["notes"] = ["the slice was left out"]
    assert "The slice was left out." in sentences(data)


def test_names_and_notes_that_look_like_markup_are_printed_as_they_are():
    data, _ = synthetic()
    example = json.loads((Path(__file__).parent / "examples" / "probe.json").read_text())
    data["per_attribute"] = [example["per_attribute"][0] | {"unit": "[/unit]", "block": "[/block]"}]
    console = Console(width=140, file=StringIO())
    console.print(family_table(probe_of(data)))
    said = console.file.getvalue()  # pyright: ignore[reportAttributeAccessIssue]
    assert [word for word in ("[/unit]", "[/block]") if word not in said] == []


def test_rendered_steps_are_told_where_they_are_known_whatever_their_curvature():
    data, _ = synthetic()
    data["steps"] = dict.fromkeys(data["traces"], 0.001)
    assert step_line(data).endswith("by curvature alone (one training)") or "by curvature alone" in step_line(data)
    sizes = {"means": 1e-5, "log_scales": 1.2e-5, "quats": 4.7e-5, "opacity_logits": 1.57e-4, "sh": -4e-6}
    data["step_rises"] = {name: (size, 1e-6) for name, size in sizes.items()}
    assert (
        "in opacity changes the loss 3.3 times as much as in rotation, then scale ≈ position, then colour"
        in step_line(data)
    )
    assert "by curvature alone" not in step_line(data)
    data["step_rises"]["quats"] = (1.5e-4, 1e-5)  # within the errors of opacity's
    assert "changes the loss most in opacity ≈ rotation, then scale" in step_line(data)

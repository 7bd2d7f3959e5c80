import json
import math
import re
import zipfile
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from analysis.records.findings import findings
from analysis.records.json_files import plain
from analysis.records.page.report import GLOSSARY, write_report
from analysis.records.page.summary import summary
from analysis.records.records import PHOTOGRAPH, RENDER, record_folder, write_record
from analysis.records.tables import number_rows
from splat.training.origin.fingerprint import Fingerprint, ViewData
from tests.analysis.records.test_findings import sentences
from tests.recorded import depth_section, long_numbers, probe_of, synthetic, written, written_map

LEVEL = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
LENS, SIZE = (9.0, 9.0, 4.0, 3.0), (8, 6)


class Page(HTMLParser):
    """Every address that a browser would fetch, the visible text by element, and the number of scripts."""

    def __init__(self, text):
        super().__init__()
        self.addresses, self.texts, self.scripts, self.tags, self.open = [], [], 0, [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.open.append(tag)
        self.scripts += tag == "script"
        self.addresses += [v for k, v in attrs if k in {"src", "href", "srcset", "data", "action", "poster"}]
        if tag in {"meta", "link", "img", "br"}:
            self.open.pop()

    def handle_endtag(self, tag):
        while self.open and self.open.pop() != tag:
            pass

    def handle_data(self, data):
        if not {"script", "style"} & set(self.open):
            self.texts.append(data)

    @property
    def text(self):
        return re.sub(r"\s+", " ", " ".join(self.texts))


def page(folder, data, arrays, picture=None):
    with record_folder(folder) as partial:
        write_record(partial, probe_of(data), arrays)
        if picture:
            Image.new("RGB", (8, 6)).save(partial / f"{picture}.png")
        path = write_report(partial)
        assert [p.name for p in partial.glob("*.tmp")] == []
    return (folder / path.name).read_text(encoding="utf-8")


def test_the_page_fetches_nothing_and_carries_its_pictures(tmp_path):
    text = page(tmp_path / "probe", *synthetic(), picture="traces")
    parsed = Page(text)
    assert len(parsed.addresses) == 1 and parsed.addresses[0].startswith("data:image/webp;base64,")
    assert "default-src 'none'" in text and "link" not in parsed.tags
    assert "connect-src" not in text and "@import" not in text.partition("</style>")[0]
    assert len(text) < 1e5


def test_a_page_without_a_slice_says_so(tmp_path):
    data, arrays = synthetic()
    data["slice"] = None
    del arrays["slice"]
    assert "No slice of the loss was recorded" in Page(page(tmp_path / "b", data, arrays)).text


def with_views(folder, names, data=None):
    usual, arrays = synthetic()
    data = data or usual
    data["provenance"]["views"] = names
    with record_folder(folder) as partial:
        write_record(partial, probe_of(data), arrays)
        for index in range(len(names)):
            for kind, level in ((PHOTOGRAPH, 255), (RENDER, 0)):
                Image.new("RGB", (8, 6), (level, 40 * index, 0)).save(partial / kind.format(index))
        write_report(partial)
    return folder / "report.html"


@pytest.mark.parametrize(
    "other", [{}, {"state": "11"}, {"data": {}}, {"question": {"objective.loss.ssim_weight": 0.0}}], ids=str
)
def test_the_map_beside_the_record_says_where_if_it_is_of_the_same(tmp_path, other):
    data, _ = synthetic()
    seen = {"a.png": ViewData(LEVEL, (0.0, 0.0, 1.0), LENS, SIZE)}
    of = plain(Fingerprint(seen, {"objective.loss.ssim_weight": 0.2, "settings.field": "largest"}, "00"))
    data["provenance"]["fingerprint"] = of | {"question": {"objective.loss.ssim_weight": 0.2, "seed": 3}}
    made = data["provenance"] | {"fingerprint": of | other}
    written_map(tmp_path / "map", made)
    text = with_views(tmp_path / "probe", ["a.png"], data).read_text(encoding="utf-8")
    here = not other
    assert text.count("data:image/") == (4 + 2 if here else 2)
    assert ("Largest &lt;curvature&gt;, 1" in text) == here and "<curvature>" not in text
    said = Page(text).text
    assert (
        "standard deviations 0.400, 0.0200, 0.0100 world units, opacity 0.70, 41 : 1 in the picture" in said
    ) == here
    assert (said.count("Not confirmed by renders.") == 1) == here
    assert (said.count("80% of e₁ turns Gaussian 3,778.") == 1) == here == ("Position: half" in said)


def _without_error(folder: Path) -> None:
    np.savez(folder / "view-000.npz", largest=np.zeros((6, 8), np.uint8))


def _bomb(folder: Path) -> None:
    content = np.lib.format.magic(1, 0)  # whose header would promise what deflates to nothing
    with zipfile.ZipFile(folder / "view-000.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        for name in ("largest", "error"):
            archive.writestr(f"{name}.npy", content + bytes(2**26))


def _changed(**end: object) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        data = json.loads((folder / "map.json").read_text())
        data["steepest"][0] |= end
        (folder / "map.json").write_text(json.dumps(data))

    return change


@pytest.mark.parametrize(
    "damage",
    [
        _without_error,
        _bomb,
        lambda folder: np.savez(folder / "view-000.npz", largest=np.zeros((6, 8)), error=np.zeros((6, 8), np.uint8)),
        lambda folder: np.savez(
            folder / "view-000.npz", largest=np.zeros((6, 9), np.uint8), error=np.zeros((6, 8), np.uint8)
        ),
        lambda folder: (folder / "steepest-e1.png").write_bytes(b"no picture"),
        lambda folder: (folder / "map.json").write_text("{"),
        _changed(file="../../secret"),
        _changed(file="/etc/passwd"),
        _changed(losses=[1.0]),
        _changed(carriers=[]),
    ],
)
def test_a_damaged_map_costs_the_page_its_pictures_alone_and_is_said(tmp_path, damage):
    data, _ = synthetic()
    data["provenance"]["fingerprint"] = plain(Fingerprint({}, {}, "00"))
    whole = with_views(tmp_path / "whole", ["a.png"], data).read_text(encoding="utf-8")
    written_map(tmp_path / "map", data["provenance"])
    Image.new("RGB", (8, 6)).save(tmp_path / "secret.png")
    damage(tmp_path / "map")
    text = with_views(tmp_path / "probe", ["a.png"], data).read_text(encoding="utf-8")
    assert text.count("data:image/") == whole.count("data:image/") == 2
    assert "The map is left out: expected" in Page(text).text


def carried(view: str) -> dict[str, Any]:
    """A record whose steepest direction one Gaussian carries, in a view of 8 x 6 px."""
    data, _ = synthetic()
    data["objective"]["sizes"] = [[8, 6]]
    found = {"gaussian": 3778, "share": 0.8, "attribute": "quats", "view": view, "outline": [2.0, 1.0, 2.0, 0.5, 0.5]}
    data["eigenvalues"]["max"]["carrier"] = found
    return data


def test_the_page_opens_with_the_gaussian_that_carries_the_steepest_direction_then_the_summary(tmp_path):
    names = ["a.png", "b <i>.png", "c.png"]
    text = with_views(tmp_path / "several", names, carried("b <i>.png")).read_text(encoding="utf-8")
    order = [text.index(each) for each in ("<svg", "<dt>scene", "<dt>steepest", 'id="views"')]
    assert order == sorted(order) and re.findall(r'viewBox="([^"]*)"', text) == ["0 0 8 6", "0 0 8 6"]
    assert text.count('<ellipse cx="2.0" cy="1.0" rx="2.0" ry="2.0" transform="rotate(28.6') == 2
    assert 'id="name">2 of 3: b &lt;i&gt;.png<' in text and 'value="1" aria-label' in text
    assert "<rect" not in text and "The render: the Gaussian" in text  # the part is the whole picture
    data = carried("a.png")
    data["eigenvalues"]["max"]["carrier"]["outline"][2] = 0.5
    narrow = with_views(tmp_path / "narrow", names, data).read_text(encoding="utf-8")
    assert '<rect x="1" y="0" width="2" height="2"/>' in narrow and "The render in the frame: the Gaussian" in narrow
    data = carried("a.png")
    data["checks"]["symmetry"] |= {"value": 0.5, "passed": False}
    assert "<svg" not in with_views(tmp_path / "doubtful", names, data).read_text(encoding="utf-8")
    assert "<svg" not in with_views(tmp_path / "elsewhere", names, carried("d.png")).read_text(encoding="utf-8")


def test_photograph_and_render_of_the_training_views_are_on_the_page(tmp_path):
    text = with_views(tmp_path / "several", ["a.png", "b <i>.png", "c.png"]).read_text(encoding="utf-8")
    assert text.count("data:image/jpeg") == 2 * 3 and 'type="range"' in text and "<i>" not in text
    alone = with_views(tmp_path / "one", ["a.png"]).read_text(encoding="utf-8")
    assert alone.count("data:image/jpeg") == 2 and 'type="range"' not in alone


def test_every_picture_has_words_with_its_numbers(tmp_path):
    data, arrays = synthetic()
    text = page(tmp_path / "probe", data, arrays, picture="traces")
    (words,) = re.findall(r'<img src="data:[^"]*" alt="([^"]*)">', text)
    assert words.startswith("Traces: position 3.99\N{NO-BREAK SPACE}×\N{NO-BREAK SPACE}10⁵, ")
    assert re.findall(r"<h(\d)", text) == sorted(re.findall(r"<h(\d)", text)) and text.count("<h1") == 1


def test_every_number_of_the_tables_is_on_the_page_with_its_error(tmp_path):
    data, arrays = synthetic()
    text = Page(page(tmp_path / "probe", data, arrays)).text
    for expected in ("(3.99 ± 0.09) × 10⁵", "−308 ± 8", "3.10 × 10⁴", "−220 ± 3", "10,091", "rademacher"):
        assert expected in text


def test_nothing_that_a_person_reads_of_a_record_has_more_than_three_digits(tmp_path):
    data, arrays = synthetic(scale=1.23456789)
    data |= {"depth": depth_section(0.123456789), "steps": dict.fromkeys(data["traces"], 0.00123456789)}
    data["objective"] |= {"value": 0.083212345, "gradient_norm": 0.4112345}
    record = written(tmp_path / "probe", data, arrays)
    told = [cell for rows in number_rows(record.data).values() for row in rows for cell in row]
    told += [*summary(record.data, Path()), *(line.text for line in findings(record.data))]
    told.append(Page(write_report(record.folder).read_text()).text.partition("Where the numbers come from")[0])
    assert len(told) > 10 and [found for text in told for found in long_numbers(text)] == []
    assert long_numbers("0.00123 of 12,345.6, 105.59800 ± 0.0004 at 1.234 × 10⁵, 12345, torch 2.10.0, 10,091") == [
        "12,345.6", "105.59800", "1.234", "12345"
    ]  # fmt: skip


def test_the_page_sets_depth_against_the_papers_factor(tmp_path):
    data, arrays = synthetic()
    assert "along the rays" not in Page(page(tmp_path / "without", data, arrays)).text
    text = Page(page(tmp_path / "with", data | {"depth": depth_section()}, arrays)).text
    for expected in (
        "depth gradient / lateral 0.00680",
        "the paper says that depth is about 100 times lateral; here it is 0.0068 times",
        "depth curvature / lateral (3.80 ± 0.10) × 10⁻⁵",
        "depth / lateral rise, 0.1 px 0.280 ± 0.020",
        "20.4 ± 0.3",
        "order changed in 75% and 50% of the renders",
        "23,054 pairs",
    ):
        assert expected in text


def test_the_glossary_has_the_words_that_the_page_uses_and_no_others(tmp_path):
    data, arrays = synthetic()
    plain_page = page(tmp_path / "plain", data, arrays)
    deep = page(tmp_path / "deep", data | {"depth": depth_section()}, arrays)
    for term, words in GLOSSARY.items():
        for text in (plain_page, deep):
            entry = f"<dt>{term}</dt><dd>{words}</dd>"
            used = term in Page(text.replace(entry, "")).text
            assert (entry in text) == used or term in ("unit", "rank", "dim", "block", "trace"), term  # within words
    assert "<dt>the paper</dt>" in deep and "<dt>the paper</dt>" not in plain_page


def test_text_of_the_record_cannot_become_markup(tmp_path):
    evil = '</script><script>alert(1)</script><img src="http://example.org/x.png">'
    data, arrays = synthetic()
    data["provenance"] |= {"scene": evil, "fingerprint": plain(Fingerprint({}, {evil: [evil]}, evil))}
    data["notes"] = [evil]
    data["slice"]["directions"][0]["name"] = evil
    data["checks"]["symmetry"]["note"] = evil
    data["traces"]["means"]["method"] = evil
    clean, hostile = Page(page(tmp_path / "a", *synthetic())), Page(page(tmp_path / "b", data, arrays))
    assert hostile.scripts == clean.scripts
    assert "img" not in hostile.tags and hostile.addresses == []
    assert "alert(1)" in hostile.text


@pytest.mark.parametrize("scale", [1e-12, 1e9])
def test_records_of_extreme_size_and_without_numbers_make_a_page(tmp_path, scale):
    data, arrays = synthetic(scale)
    data["traces"]["means"] |= {"value": None, "standard_error": None, "low": None, "high": None, "tau": math.nan}
    data["eigenvalues"]["min"] |= {"value": math.nan}
    arrays["slice"]["loss"][:3] = math.nan
    text = Page(page(tmp_path / "probe", data, arrays)).text
    assert "not a number" in text and "The extreme eigenvalues were not determined" in text


def test_a_number_without_its_error_is_never_shown_as_exact(tmp_path):
    data, arrays = synthetic()
    data["traces"]["means"] |= {"value": 4e5, "standard_error": None, "sign": "undetermined"}
    assert "4.00 × 10⁵ ± ?" in Page(page(tmp_path / "probe", data, arrays)).text


def test_a_failed_check_comes_first_and_in_red(tmp_path):
    data, arrays = synthetic()
    assert sentences(data, "failure") == ""
    data["checks"]["symmetry"] |= {"value": 0.5, "passed": False}
    first = findings(probe_of(data))[0]
    assert first.level == "failure" and "symmetry failed: 0.500" in first.text
    assert 'class="failure">The check of symmetry failed' in page(tmp_path / "probe", data, arrays)


@pytest.mark.parametrize(
    ("index", "settings", "reason", "command"),
    [
        ("top_mass", {"density_matvecs": 108}, "tolerance", "run --end-products 15 --density-products 432"),
        ("eigenvalue_ratio", {}, "matvec budget", "run --density-products 9 --end-products 60"),
        ("eigenvalue_ratio", {}, "noise floor", None),
    ],
)
def test_a_number_without_finite_bracket_is_none_and_names_what_resolves_it(tmp_path, index, settings, reason, command):
    data, arrays = synthetic()
    data["anisotropy"][index] = {"value": 0.73519, "low": 0.5, "high": None, "note": "open"}
    data["eigenvalues"]["min"] |= {"reason": reason, "matvecs": 15}
    asked = {f"settings.{name}": value for name, value in settings.items()}
    data["provenance"] |= {"fingerprint": plain(Fingerprint({}, asked, "00"))}
    data["provenance"] |= {"command": "landscape probe run --end-products 15 --density-products 9"}
    (line,) = (line for line in findings(probe_of(data)) if line.level == "open")
    assert line.text.startswith(f"{index.replace('_', ' ').capitalize()}: – (at least 0.500); ")
    assert line.text.endswith(f"{command}." if command else "no more products resolve it.")
    text = Page(page(tmp_path / "probe", data, arrays)).text
    assert not re.search(r"735|0\.74", text) and "0.500" in text
    assert not re.search(r"735|0\.74", str(number_rows(probe_of(data))))


def test_a_number_whose_bracket_is_tens_of_times_wide_is_none_and_only_a_caution(tmp_path):
    data, arrays = synthetic()
    data["anisotropy"]["negative_ratio"] = {"value": 0.009731, "low": 0.0015, "high": 0.0151, "note": "4 starts"}
    (line,) = (line for line in findings(probe_of(data)) if line.text.startswith("Negative ratio"))
    assert line.level == "caution" and "– (between 0.00150 and 0.0151)" in line.text
    text = Page(page(tmp_path / "probe", data, arrays)).text
    assert "0.00973" not in text
    data["anisotropy"]["eigenvalue_ratio"] = {"value": -97.31, "low": -151.0, "high": -15.0, "note": ""}
    data["depth"] = depth_section() | {"curvature_ratio": {"value": 97.31, "low": 15.0, "high": 151.0, "note": ""}}
    assert "97.3" not in sentences(data) and "97.3" not in " ".join(summary(probe_of(data), Path()))
    data["anisotropy"]["negative_ratio"]["high"] = 0.0149
    assert not any(line.text.startswith("Negative ratio") for line in findings(probe_of(data)))


def test_the_page_of_the_splats_is_linked_where_it_is(tmp_path):
    path = with_views(tmp_path / "probe", ["a.png"])
    assert "view.html" not in path.read_text(encoding="utf-8")
    (tmp_path / "view.html").write_text("")
    assert '<a href="../view.html">' in write_report(path.parent).read_text(encoding="utf-8")


def test_the_title_and_the_checks_say_what_is_known(tmp_path):
    data, arrays = synthetic()
    text = Page(page(tmp_path / "whole", data, arrays)).text
    assert (
        "Loss landscape of fern, 3 views, 2,000 steps" in text
        and "checks 2 of 3 passed, not finite difference time 45 s" in text
    )
    del data["provenance"]["scene"], data["provenance"]["iteration"]
    data["counts"] |= {"views": 1}
    data["checks"] = {"symmetry": data["checks"]["symmetry"]}
    text = Page(page(tmp_path / "less", data, arrays)).text
    assert "Loss landscape of a checkpoint, 1 view " in text and "checks all 1 passed time 45 s" in text

"""The README and the pages: links lead somewhere, pages are listed, and no user reads a word that only we knew."""

import ast
import re
from pathlib import Path

import pytest

from splat.training.methods.methods import METHODS
from splat.training.origin.presets import PRESETS

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "notebooks/results/README.md")]
PAGES += sorted((ROOT / "docs").glob("*.md"))
LINK = re.compile(r"\]\(([^)#\s]*)(?:#([\w-]+))?\)")
PRIVATE = re.compile(
    r"\b(literal|(?<!font\.)famil(y|ies)|coupling|(?<!pointer: )coarse|caps and cuts|stored units?|(?<!no )saddle|the ends)\b"
)
IN_FILES = {"literal", "coupling", "coarse", "family"}  # keys of settings, of checkpoints and of tables


def headings(page: Path) -> set[str]:
    """The anchors of a page."""
    found = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.M)
    return {re.sub(r"[^\w -]", "", words).strip().lower().replace(" ", "-") for words in found}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_link_leads_to_a_file_and_its_heading(page):
    for target, anchor in LINK.findall(page.read_text(encoding="utf-8")):
        if "://" not in target:
            there = page.parent / target if target else page
            assert there.exists(), target
            assert not anchor or anchor in headings(there), f"{target}#{anchor}"


def test_the_readme_is_short_and_every_page_and_notebook_is_listed():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 120
    listed = set(re.findall(r"[\w-]+\.(?:md|ipynb)", (ROOT / "mkdocs.yml").read_text(encoding="utf-8")))
    notebooks = {path.name: path.read_text(encoding="utf-8") for path in (ROOT / "notebooks").glob("*.ipynb")}
    assert not [name for name, text in notebooks.items() if "](../" in text]  # they lie in two folders
    assert listed == {p.name for p in (ROOT / "docs").iterdir() if p.suffix in (".md", ".ipynb")} >= {*notebooks}


def test_every_trainer_and_every_method_has_a_row_on_its_page():
    pages = {"other-tools": PRESETS, "methods": METHODS}
    rows = {page: re.findall(r"^\|(.*)", (ROOT / f"docs/{page}.md").read_text("utf-8"), re.M) for page in pages}
    assert not [name for page, names in pages.items() for name in names if f"`{name}`" not in "".join(rows[page])]


def said(path: Path) -> list[str]:
    """What a module may say: its texts, without its docstrings where they are no options' help."""
    text = path.read_text(encoding="utf-8")
    nodes = [*ast.walk(ast.parse(text))] if PRIVATE.search(text) else []
    silent = [id(node.value) for node in nodes if isinstance(node, ast.Expr) and path.name != "options.py"]
    texts = [node for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str)]
    return [str(node.value) for node in texts if id(node) not in silent and node.value not in IN_FILES]


def test_no_user_reads_a_word_that_only_we_knew():
    whole = (ROOT / "README.md", *(ROOT / "docs").glob("*.md"), *(ROOT / "analysis").rglob("*.jinja"))
    read = {path: [path.read_text(encoding="utf-8")] for path in whole}
    for name in ("landscape", "splat", "analysis", "figures"):
        read |= {path: said(path) for path in (ROOT / name).rglob("*.py")}
    hits = [(path, text, hit) for path, texts in read.items() for text in texts for hit in PRIVATE.finditer(text)]
    assert not [f"{path.name}: {text[max(hit.start() - 40, 0) : hit.end() + 20]!r}" for path, text, hit in hits]

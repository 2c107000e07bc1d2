"""The README's table of equations names only what exists."""

import importlib
import re
from pathlib import Path

import results.plot as plot
from train import ARMS

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()
RESULTS = (ROOT / "results" / "README.md").read_text()
TABLE = README.split("<!-- equations -->")[1].split("<!-- end of equations -->")[0]


def names(column: int) -> list[str]:
    """The names in backquotes in one column of the table."""
    rows = [line.split("|")[1:-1] for line in TABLE.splitlines() if line.startswith("|")][2:]
    return [name for row in rows for name in re.findall(r"`([^`]+)`", row[column])]


def test_every_function_in_the_table_exists():
    for name in names(1):
        file, _, path = name.partition(": ")
        thing = importlib.import_module(file.removesuffix(".py"))
        for part in path.split("."):
            fields = getattr(thing, "__dataclass_fields__", {})
            assert hasattr(thing, part) or part in fields, name
            thing = getattr(thing, part, None)


def test_every_test_in_the_table_exists():
    for name in names(2):
        file, _, test = name.partition(": ")
        assert f"def {test}(" in (Path(__file__).parent / file).read_text(), name


def test_the_table_covers_every_labelled_equation_and_modification():
    for equation in range(1, 11):
        assert f"({equation})" in TABLE, equation
    for modification in ("termination", "rearrangement", "fixed prior", "minor 1", "minor 2"):
        assert modification in TABLE
    assert "minor 3" in TABLE and "minor 4" in TABLE


def test_the_table_of_results_is_of_the_last_fifths_of_the_whole_runs():
    earned = {}
    for env, arms in plot.read_runs(plot.WHOLE).items():
        for arm, runs in arms.items():
            assert sorted(runs) == [str(seed) for seed in range(len(runs))]  # 0, 1, 2
            scores = [plot.score(run, run["env_steps"][-1]) for _, run in sorted(runs.items())]
            earned[env, arm] = [f"{score:,.0f}".replace("-", "−") for score in scores]
    header, _, *rows = README.split("## Status")[1].split("\n\n")[2].splitlines()
    arms = [arm.strip("`") for arm in cells(header)[1:5]]
    assert set(arms) == set(ARMS) and len(rows) == 4
    for robot, *of_arms in map(cells, rows):
        for arm, cell in zip(arms, of_arms[:4], strict=True):
            found = earned.pop((f"{robot}BulletEnv-v0", arm), ["–"])
            assert cell == ", ".join(found), (robot, arm)
    assert not earned


def cells(row: str) -> list[str]:
    """The cells of a row of a table."""
    return [cell.strip() for cell in row.strip("|").split("|")]


def test_the_table_of_speed_is_what_the_benchmark_printed():
    rows = (ROOT / "results" / "benchmark.md").read_text().splitlines()
    assert len(rows) == 20 and not [row for row in rows if row not in RESULTS]


def test_links_lead_somewhere():
    for page in (ROOT / "README.md", *(ROOT / "results" / n for n in ("README.md", "trials.md"))):
        for link in re.findall(r"\]\(([^)]+)\)", page.read_text()):
            if not link.startswith("http"):
                file, _, anchor = link.partition("#")
                target = page.parent / file if file else page
                assert target.exists(), link
                assert not anchor or anchor in anchors(target.read_text()), link


def anchors(page: str) -> list[str]:
    """What a link may name on a page: its headings, as GitHub writes them."""
    headings = re.findall(r"^#+ (.*)", page, re.MULTILINE)
    return [re.sub(r"[^\w\- ]", "", name.lower()).replace(" ", "-") for name in headings]


def test_the_readme_is_short():
    assert len(README.splitlines()) <= 220


def test_nothing_is_left_to_be_filled_in():
    assert "@@" not in README + RESULTS

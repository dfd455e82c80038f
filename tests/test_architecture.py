"""The layout keeps its promises: importing is free, stages import only what comes before them."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import loopclosure

SOURCE = Path(loopclosure.__file__).parent
STAGES = ("images", "features", "compression", "aggregation", "matching", "verification")
SHARED = {"records", "errors", "config", "weights", "store", "timing"}
ABOVE = {
    "bundle",
    "perception",
    "decision",
    "detect",
    "traverse",
    "warmup",
    "runfiles",
    "runs",
    "methods",
    "training",
    "evaluation",
    "report",
    "placemap",
    "service",
    "cli",
}


def test_import_loads_no_stage_and_changes_nothing():
    check = (
        "import sys, logging; before = list(logging.root.handlers); import loopclosure;"
        "heavy = {'torch', 'cv2', 'matplotlib', 'sklearn', 'scipy', 'numpy'} & set(sys.modules);"
        "assert not heavy, heavy; assert logging.root.handlers == before;"
        "assert not {name for name in sys.modules if name.startswith('loopclosure.')}"
    )
    subprocess.run([sys.executable, "-c", check], check=True)


def test_public_names_exist():
    for name in loopclosure.__all__:
        assert getattr(loopclosure, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'Nonsense'"):
        loopclosure.Nonsense  # noqa: B018


def imported_parts(path):
    """First component below `loopclosure` of everything that a file imports from the package."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: a relative import hides where it leads"
            whole = node.module == "loopclosure"
            names = [f"loopclosure.{alias.name}" for alias in node.names] if whole else [node.module]
        yield from (name.split(".")[1] for name in names if name.startswith("loopclosure."))


@pytest.mark.parametrize("stage", STAGES)
def test_a_stage_imports_only_shared_modules_and_earlier_stages(stage):
    allowed = SHARED | set(STAGES[: STAGES.index(stage) + 1])
    files = [*SOURCE.glob(f"{stage}.py"), *SOURCE.glob(f"{stage}/**/*.py")]
    wrong = [(str(file), part) for file in files for part in imported_parts(file) if part not in allowed]
    assert not wrong


def test_training_imports_no_later_stage():
    allowed = SHARED | set(STAGES) | {"training", "methods", "evaluation", "__version__"}
    wrong = [(str(file), part) for file in SOURCE.glob("training/*.py") for part in imported_parts(file)]
    assert not [(file, part) for file, part in wrong if part not in allowed]


def test_every_module_belongs_to_the_layout():
    parts = {path.stem for path in SOURCE.iterdir() if path.suffix == ".py" or path.is_dir()}
    assert parts - {"__init__", "__pycache__", "py"} <= SHARED | set(STAGES) | ABOVE

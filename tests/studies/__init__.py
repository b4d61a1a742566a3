"""Small studies of every kind of system, as a user has them: a YAML file and tables."""

from pathlib import Path

from diffsim.data import load_study
from diffsim.data.study import Study

HERE = Path(__file__).parent
NAMES = tuple(sorted(path.parent.name for path in HERE.glob("*/study.yaml")))


def study_of(name: str) -> Study:
    """The study of a folder."""
    return load_study(HERE / name / "study.yaml")

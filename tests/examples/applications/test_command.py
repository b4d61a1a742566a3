"""The command line of application scripts."""

from examples.applications.command import main
from tests.examples.applications.test_applications import made


def test_no_evaluations_show_where_the_search_begins(tmp_path, capsys):
    application = made()
    first = application.parameters.first
    expected = application.numbers(first, application.motion(first))
    asked = ["--evaluations", "0", "--no-pictures", "--out", str(tmp_path)]
    assert main(lambda _solver, _quick: made(), "A test.", argv=asked) == dict(expected)
    printed = capsys.readouterr().out
    assert all(name in printed for name in expected)
    assert list(tmp_path.iterdir()) == []  # nothing was optimized

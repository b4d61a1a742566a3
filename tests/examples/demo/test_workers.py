"""Jobs side by side: order kept, failure and Ctrl-C end all."""

import threading

import pytest

from examples.demo.workers import Stopped, Workers


@pytest.mark.parametrize("threads", [1, 3])
def test_results_come_in_the_order_of_the_jobs(threads):
    workers = Workers(threads, 10, quiet=True)
    assert workers.run([lambda i=i: i * i for i in range(7)]) == [i * i for i in range(7)]
    workers.close()


def test_a_failure_stops_the_other_jobs():
    workers = Workers(2, 10, quiet=True)
    started, ended = threading.Event(), []

    def endless():
        started.set()
        try:
            while True:
                workers.tick()
        except Stopped:
            ended.append(True)
            raise

    def failing():
        started.wait(10)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        workers.run([failing, endless])
    assert ended == [True]


def test_the_bar_follows_the_plan():
    workers = Workers(1, 30)
    workers.stage("first", 10)
    for _ in range(25):  # more steps than planned do not run into the next stage
        workers.tick()
    assert workers.bar.n == 10
    workers.stage("second", 20)
    workers.tick()
    assert workers.bar.n == 11
    workers.close()
    assert workers.bar.n == 30


def test_a_stage_says_what_it_is_doing_and_how_far_it_is():
    workers = Workers(1, 30)
    workers.stage("fits", 10)
    workers.stage("diagnosis", 18)
    workers.note("search, drag", 0.5)
    assert str(workers.bar).rstrip("]").endswith(", diagnosis: search, drag")
    assert workers.bar.n == 19
    workers.note("a part again", 0.3)  # never back
    assert workers.bar.n == 19
    workers.stage("page", 2)
    assert "diagnosis" not in str(workers.bar) and workers.bar.n == 28 < workers.bar.total
    workers.close()


def test_results_are_said_above_the_bar(capsys):
    for quiet, expected in ((False, ["the first"]), (True, [])):
        workers = Workers(1, 30, quiet=quiet)
        workers.say("the first")
        assert capsys.readouterr().out.splitlines() == expected
        workers.bar.close()


def test_no_threads_is_refused():
    with pytest.raises(ValueError, match="threads must be at least 1, got 0"):
        Workers(0, 1)

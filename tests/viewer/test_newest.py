"""Only the newest request is worked on."""

import logging
import threading

from sarsplat.viewer.server import Newest


def test_many_requests_during_one_piece_of_work_are_one_more():
    begun, go_on, seen, state = threading.Event(), threading.Event(), [], [0]

    def work() -> None:
        begun.set()
        go_on.wait(10)
        seen.append(state[0])

    newest = Newest(work)
    newest.ask()
    assert begun.wait(10)
    for k in range(1, 51):
        state[0] = k
        newest.ask()
    assert not newest.wait(0.01)
    go_on.set()
    assert newest.wait(10)
    newest.close()
    assert seen == [50, 50]


def test_an_error_is_logged_and_the_next_request_is_served(caplog):
    done = []

    def work() -> None:
        done.append(1)
        if len(done) == 1:
            raise ValueError("no picture")

    newest = Newest(work)
    with caplog.at_level(logging.ERROR, "sarsplat"):
        for _ in range(2):
            newest.ask()
            assert newest.wait(10)
    newest.close()
    assert len(done) == 2
    assert "no picture" in caplog.text

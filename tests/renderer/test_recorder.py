"""What records steps: in which order CUDA is asked, and what is told by the arguments of a launch."""

import gc
import weakref
from contextlib import contextmanager
from types import SimpleNamespace

import pytest
import torch
from emulated_cuda import EmulatedRecorder, Emulator

from sarsplat.renderer.engines import on_device, recorder
from sarsplat.renderer.engines.on_device import NotRecordable, kept_on_device
from sarsplat.renderer.engines.recorder import MOST_WORDS, Recorder, Told

CPU = torch.device("cpu")


class Log(list):
    """Streams and graphs that only say what they are asked."""

    fails = False
    """True if a record cannot be ended."""

    def stream(self, name: str) -> SimpleNamespace:
        return SimpleNamespace(wait_stream=lambda other: self.append(f"{name} waits"))

    def graph(self) -> SimpleNamespace:
        return SimpleNamespace(
            capture_begin=lambda **options: self.append(f"begin {options}"),
            capture_end=self._end,
            replay=lambda: self.append("replay"),
            pool=lambda: 7,
        )

    def _end(self) -> None:
        self.append("end")
        if self.fails:
            raise RuntimeError("operation failed due to a previous error during capture")

    @contextmanager
    def on(self, stream: object):
        self.append("on the own stream")
        yield
        self.append("back")


@pytest.fixture
def log(monkeypatch: pytest.MonkeyPatch) -> Log:
    log = Log()
    usual = log.stream("usual")
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: usual)
    monkeypatch.setattr(torch.cuda, "stream", log.on)
    monkeypatch.setattr(torch.cuda, "CUDAGraph", log.graph)
    monkeypatch.setattr(recorder, "_IDLE", {})
    monkeypatch.setattr(recorder, "_RETIRED", [])
    return log


@pytest.fixture
def gpu(log: Log) -> SimpleNamespace:
    """What a recorder asks of a GPU besides launches."""
    return SimpleNamespace(device=torch.device("cuda", 0), new_stream=lambda: log.stream("own"))


def test_a_program_is_recorded_on_a_stream_of_its_own_and_run_on_the_usual_one(log, gpu):
    recorder = Recorder(gpu)
    assert recorder.rehearse(lambda: log.append("program") or 3) == 3
    around = ["own waits", "on the own stream"], ["back", "usual waits"]
    assert log == [*around[0], "program", *around[1]]
    log.clear()
    result, run = recorder.record(lambda: log.append("program") or 4)
    begun = "begin {'pool': None, 'capture_error_mode': 'thread_local'}"
    assert log == [*around[0], begun, "program", "end", *around[1]]
    log.clear()
    run()
    assert (result, log) == (4, ["replay"])
    recorder.record(lambda: None)
    assert "begin {'pool': 7, 'capture_error_mode': 'thread_local'}" in log  # the memory of the one before


def test_recorders_have_a_stream_each_and_hand_it_on(log, gpu):
    first, second = Recorder(gpu), Recorder(gpu)
    streams = first._stream, second._stream
    assert streams[0] is not streams[1]
    _, run = first.record(lambda: None)
    del first
    assert Recorder(gpu)._stream not in streams  # whoever can run it holds the recorder
    del run
    log.clear()
    assert Recorder(gpu)._stream is streams[0]
    assert log == ["own waits"]  # for what may still be running


def test_graphs_leave_only_when_nobody_records(log, gpu):
    first, second = Recorder(gpu), Recorder(gpu)
    first.record(lambda: None)

    def program() -> None:
        nonlocal first
        del first
        gc.collect()
        assert len(recorder._RETIRED) == 1

    second.record(program)
    assert recorder._RETIRED == []
    third = Recorder(gpu)
    third.record(lambda: None)
    del third
    assert recorder._RETIRED == []


@pytest.mark.parametrize("fails", [False, True])
def test_a_record_that_fails_is_ended_and_says_why(fails, log, gpu):
    def program() -> None:
        log.fails = fails
        raise NotRecordable("no")

    with pytest.raises(NotRecordable, match="no"):
        Recorder(gpu).record(program)
    assert "end" in log


def test_the_latest_record_keeps_what_it_reads_of_all_that_is_kept(log, gpu):
    table = kept_on_device(maxsize=1)(lambda size, device: torch.arange(size, device=device))
    recorder = Recorder(gpu)
    recorder.record(lambda: [table(3, CPU)].clear())
    read = weakref.ref(table(3, CPU))
    table(4, CPU)  # the only one that is kept
    assert read() is not None
    recorder.record(lambda: None)
    assert read() is None


def test_what_is_told_arrives(library):
    recorder = EmulatedRecorder(Emulator(library))
    told = Told(recorder, {"rates": (torch.float32, 3), "chosen": (torch.int64, 2), "more": (torch.int32, 300)})
    chosen, rates, more = (told.tensors[name] for name in ("chosen", "rates", "more"))
    told.tell(chosen=torch.tensor([2**40, -1]), rates=torch.tensor([0.5, 1e-3, 3.0]), more=torch.arange(300))
    assert chosen.tolist() == [2**40, -1]
    assert torch.equal(rates, torch.tensor([0.5, 1e-3, 3.0]))
    assert torch.equal(more, torch.arange(300).int())
    told.tell(rates=torch.zeros(3))
    assert (chosen.tolist(), rates.tolist()) == ([2**40, -1], [0.0, 0.0, 0.0])
    with pytest.raises(RuntimeError):
        Told(recorder, {"too much": (torch.int32, MOST_WORDS + 1)}).tell(**{"too much": torch.zeros(MOST_WORDS + 1)})


def test_what_is_kept_on_a_device_is_made_once_and_never_in_a_record(monkeypatch):
    made = []

    @kept_on_device(maxsize=2)
    def table(size: int, device: torch.device) -> torch.Tensor:
        made.append(size)
        return torch.arange(size, device=device)

    assert table(3, CPU) is table(3, CPU)
    with monkeypatch.context() as patch:
        patch.setattr(on_device, "being_recorded", lambda: True)
        assert table(3, CPU) is table(3, CPU)
        with pytest.raises(NotRecordable, match="table sends something to the device in every step"):
            table(4, CPU)
    assert made == [3]
    assert table(4, CPU).tolist() == [0, 1, 2, 3]


def test_what_is_kept_is_kept_for_each_queue(monkeypatch):
    queue = 1
    monkeypatch.setattr(on_device, "queue_of", lambda device: queue)

    @kept_on_device(maxsize=1)
    def table(size: int, device: torch.device) -> torch.Tensor:
        return torch.arange(size, device=device)

    mine = table(3, CPU)
    queue = 2
    assert table(3, CPU) is not mine
    table(4, CPU)  # drives out what this queue had
    queue = 1
    assert table(3, CPU) is mine

"""Rows by executors: several processes, and a Dask cluster one of whose workers is killed on the way."""

import argparse
import concurrent.futures
import functools
import os
import pathlib
import signal
import socket
import subprocess
import sys
import time

import pytest

from executors import ExecutorError, add_option, executor_of, results
from rows import Rows

EXPERIMENTS = pathlib.Path(__file__).parents[1] / "experiments"


def slow_square(folder: pathlib.Path, number: int) -> dict[str, int]:
    """Leaves a note of who does it, then takes its time."""
    (folder / f"{number}-{os.getpid()}").touch()
    time.sleep(0.2)
    return {"square": number**2, "process": os.getpid()}


def die(number: int) -> dict[str, int]:
    os.kill(os.getpid(), signal.SIGKILL)
    return {}


def rows_in(folder: pathlib.Path) -> Rows:
    return Rows(folder / "rows.jsonl", ("number",))


def lives(process: str) -> bool:
    try:
        state = pathlib.Path("/proc", process, "stat").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return False
    return not state.rpartition(")")[2].lstrip().startswith("Z")


KEYS = [(number,) for number in range(20)]


def test_one_process_is_this_one_and_the_default(tmp_path):
    parser = argparse.ArgumentParser()
    add_option(parser)
    with executor_of(parser.parse_args([]).executor) as executor:
        assert executor is None
        rows_in(tmp_path).run(KEYS[:2], functools.partial(slow_square, tmp_path), executor=executor, progress=False)
    assert [row["process"] for row in rows_in(tmp_path).read()] == [os.getpid()] * 2


def test_processes_share_the_rows_and_a_killed_one_costs_nothing_that_was_done(tmp_path):
    rows = rows_in(tmp_path)
    with executor_of("2") as executor:
        rows.run(KEYS[:6], functools.partial(slow_square, tmp_path), executor=executor, progress=False)
        made = rows.read()
        assert sorted(row["square"] for row in made) == [number**2 for number in range(6)]
        assert len({row["process"] for row in made}) == 2 and os.getpid() not in {row["process"] for row in made}
        with pytest.raises(ExecutorError, match="run the same command"):
            rows.run(rows.missing(KEYS[:7]), die, executor=executor, progress=False)
    assert rows.read() == made and rows.missing(KEYS[:7]) == [(6,)]


@pytest.mark.skipif(not pathlib.Path("/proc/self/stat").exists(), reason="reads /proc")
def test_workers_end_with_the_process_that_is_killed(tmp_path):
    """Or they would wait for the next row for ever, each with the memory of a simulation."""
    script = (
        "import os, signal\n"
        "from executors import executor_of\n"
        "if __name__ == '__main__':\n"
        "    with executor_of('2') as pool:\n"
        "        print(pool.submit(os.getpid).result(), flush=True)\n"
        "        os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    (tmp_path / "killed.py").write_text(script)
    program = [sys.executable, str(tmp_path / "killed.py")]
    paths = os.pathsep.join(filter(None, [str(EXPERIMENTS), os.environ.get("PYTHONPATH")]))
    run = subprocess.run(program, capture_output=True, text=True, timeout=120, env={**os.environ, "PYTHONPATH": paths})
    assert run.returncode == -signal.SIGKILL, run.stderr
    worker, deadline = run.stdout.strip(), time.monotonic() + 30.0
    while lives(worker) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not lives(worker)


def test_any_executor_will_do_and_no_row_is_begun_when_the_time_is_up(tmp_path):
    with concurrent.futures.ThreadPoolExecutor(2) as executor:
        make = functools.partial(slow_square, tmp_path)
        rows_in(tmp_path).run(KEYS, make, executor=executor, seconds=0.3, progress=False)
    assert 1 <= len(rows_in(tmp_path).read()) <= 6


def test_an_error_in_a_row_is_that_error(tmp_path):
    with executor_of("2") as executor, pytest.raises(TypeError):
        rows_in(tmp_path).run(KEYS, slow_square, executor=executor, progress=False)


@pytest.mark.parametrize("text", ["0", "-1", "x", "1e3", "", "²"])
def test_what_is_no_executor_is_said_at_once(text):
    with pytest.raises(ExecutorError, match="expected a number of processes or tcp://"), executor_of(text):
        pass


# --- Dask -------------------------------------------------------------------------------------------------------------


def free_port() -> int:
    with socket.socket() as place:
        place.bind(("127.0.0.1", 0))
        return place.getsockname()[1]


def start(*words: str, folder: pathlib.Path) -> subprocess.Popen:
    """A program of Dask, which does not find the experiments on its path."""
    command = [sys.executable, "-m", "distributed.cli." + words[0], *words[1:]]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    environment["PYTHONPATH"] = str(EXPERIMENTS.parent / "src")
    with (folder / f"{words[0]}-{time.time_ns()}.log").open("w") as log:
        return subprocess.Popen(command, cwd=folder, env=environment, stdout=log, stderr=log)


@pytest.fixture
def cluster(tmp_path):
    """The address of a scheduler with two workers, and the workers' processes."""
    pytest.importorskip("distributed")
    address = f"tcp://127.0.0.1:{(port := free_port())}"
    local = ["--host", "127.0.0.1"]
    programs = [start("dask_scheduler", *local, "--port", str(port), "--no-dashboard", folder=tmp_path)]
    alone = ["--nthreads", "1", "--no-nanny", "--no-dashboard", "--death-timeout", "60"]
    try:
        yield address, programs, functools.partial(start, "dask_worker", address, *local, *alone, folder=tmp_path)
    finally:
        for program in reversed(programs):
            program.kill()
            program.wait()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_cluster_that_loses_a_worker_loses_no_row(cluster, tmp_path):
    address, programs, worker = cluster
    with pytest.raises(ExecutorError, match="has no workers"):
        connect(address)
    programs += [worker(), worker()]
    wait_for_workers(address, 2)
    notes, rows = tmp_path / "notes", rows_in(tmp_path)
    notes.mkdir()
    with executor_of(address) as executor:
        make = functools.partial(slow_square, notes)
        kept, killed = rows.path, programs[1].pid

        def keep(made):
            if programs[1].poll() is None and kept.exists():  # after the first row
                programs[1].kill()
            return made

        rows.run(KEYS, make, executor=executor, keep=keep, progress=False)
    made = rows.read()
    assert sorted((row["number"], row["square"]) for row in made) == [(n, n * n) for (n,) in KEYS]
    assert len(kept.read_text().splitlines()) == len(KEYS), "nothing is doubled"
    assert programs[1].poll() is not None
    begun = [int(note.name.split("-")[1]) for note in notes.iterdir()]
    assert killed in begun and sum(row["process"] == killed for row in made) < begun.count(killed)


@pytest.mark.filterwarnings("ignore")
def test_a_cluster_that_loses_all_its_workers_is_not_waited_for(cluster, tmp_path, monkeypatch):
    address, programs, worker = cluster
    programs.append(worker())
    wait_for_workers(address, 1)
    monkeypatch.setattr("executors.SECONDS", 1.0)
    with executor_of(address) as executor, pytest.raises(ExecutorError, match="no workers any more"):
        programs[1].kill()
        rows_in(tmp_path).run(KEYS, functools.partial(slow_square, tmp_path), executor=executor, progress=False)


def connect(address: str) -> None:
    # a scheduler that has only just started may not answer yet
    with executor_of(address):
        pass


def wait_for_workers(address: str, count: int) -> None:
    from distributed import Client

    with Client(address, timeout=60, set_as_default=False) as client:
        client.wait_for_workers(count, timeout=120)


def test_a_cluster_that_cannot_be_reached_is_a_message_at_the_start(monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr("executors.SECONDS", 1)
    for address in (f"tcp://127.0.0.1:{free_port()}", "tcp://127.0.0.1", f"tls://127.0.0.1:{free_port()}"):
        with pytest.raises(ExecutorError, match=f"No Dask scheduler answers at {address}"):
            connect(address)


@pytest.mark.parametrize("executor", ["2", "1"])
def test_rows_that_have_begun_are_kept_when_the_time_is_up(tmp_path, executor):
    """Each process has a row in hand then; they are waited for, and were thrown away."""
    rows = rows_in(tmp_path)
    with executor_of(executor) as pool:
        rows.run(KEYS, functools.partial(slow_square, tmp_path), executor=pool, seconds=0.3, progress=False)
    made, begun = {row["number"] for row in rows.read()}, {int(p.name.split("-")[0]) for p in tmp_path.glob("*-*")}
    assert made == begun and 0 < len(made) < len(KEYS)


def square_or_fail(number: int) -> dict[str, int]:
    if number == 0:
        raise ValueError("number 0 fails")
    return {"square": number**2}


def test_a_row_that_fails_does_not_lose_those_that_were_done_with_it():
    """The order in which finished rows come is not theirs."""

    class Finished(concurrent.futures.Executor):
        def submit(self, fn, /, *args, **kwargs):
            future = concurrent.futures.Future()
            try:
                future.set_result(fn(*args, **kwargs))
            except ValueError as error:
                future.set_exception(error)
            return future

    done = []
    with pytest.raises(ValueError, match="number 0 fails"):
        for key, result in results(Finished(), square_or_fail, KEYS[:4]):
            done.append((key, result["square"]))
    assert sorted(done) == [((1,), 1), ((2,), 4), ((3,), 9)]

"""Campaigns: complete tables whatever dies on the way, and nothing done twice."""

from __future__ import annotations

import gc
import os
import signal
import socket
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from distributed import default_client

from modeharvest.util import RELEASE
from modeharvest.util.errors import InputError
from modeharvest.util.files import read_json, write_json
from modeharvest.util.stages import source_digest
from modeharvest.validation import workers
from modeharvest.validation.campaign import Campaign, grid
from modeharvest.validation.workers import Workers

BASE = {"x": 0, "wait": 0.0, "bad": -1}


def squares(folder: Path, **axes: list[float]) -> Campaign:
    return Campaign("campaign_cases:square", grid(BASE, **axes), folder)


def test_a_grid_is_every_combination() -> None:
    cases = grid(BASE, x=[1, 2], bad=[0, 5, 7])
    assert len(cases) == 6
    assert cases[1] == {"x": 1, "wait": 0.0, "bad": 5}


@pytest.mark.parametrize(
    ("axes", "message"),
    [
        ({"z": [1]}, "expected axes among"),
        ({"x": []}, "expected different values of 'x'"),
        ({"x": [1, 1]}, "expected different values of 'x'"),
    ],
)
def test_bad_grids_are_one_line(axes: dict[str, list[int]], message: str) -> None:
    with pytest.raises(InputError, match=message):
        grid(BASE, **axes)


def test_bad_campaigns_are_one_line(tmp_path: Path) -> None:
    for function in ("no.such.module:f", "campaign_cases:no_such", "campaign_cases"):
        with pytest.raises(InputError, match="expected a function"):
            Campaign(function, (BASE,), tmp_path)
    with pytest.raises(InputError, match="same keys"):
        Campaign("campaign_cases:square", (BASE, {**BASE, "y": 1}), tmp_path)
    with pytest.raises(InputError, match="at least one case"):
        Campaign("campaign_cases:square", (), tmp_path)


def greet(server: socket.socket) -> None:
    """Answer once as a mail server would."""
    connection, _ = server.accept()
    with connection:
        connection.sendall(b"220 mail\r\n" * 9)


def test_a_scheduler_that_is_not_there_is_one_line(tmp_path: Path) -> None:
    with socket.socket() as other:  # a server that says something else
        other.bind(("127.0.0.1", 0))
        other.listen()
        other.settimeout(600.0)  # of a machine however slow
        answer = threading.Thread(target=greet, args=(other,))
        answer.start()
        no_scheduler = f"tcp://127.0.0.1:{other.getsockname()[1]}"
        for address in ("no-scheme-at-all://nowhere", no_scheduler):
            with pytest.raises(InputError, match="expected a dask scheduler at"):
                squares(tmp_path, x=[1]).run(Workers(scheduler=address))
        answer.join()


@pytest.fixture
def scheduler() -> Iterator[str]:
    """The address of a scheduler with a worker, both in a process of their own."""
    program = textwrap.dedent(f"""
        import sys, time
        sys.path.insert(0, {str(Path(__file__).parent)!r})
        from distributed import LocalCluster
        options = dict(processes=False, protocol="tcp", dashboard_address=":0")
        with LocalCluster(n_workers=1, threads_per_worker=1, **options) as cluster:
            print(cluster.scheduler_address, flush=True)
            sys.stdin.read()
    """)
    pipe = subprocess.PIPE
    command = [sys.executable, "-c", program]
    process = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True)
    assert process.stdout is not None
    yield process.stdout.readline().strip()
    process.communicate()


def test_a_scheduler_does_the_work_and_what_is_done_outlives_it(
    scheduler: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    elsewhere = Workers(scheduler=scheduler)
    elsewhere.require_ready("campaign_cases:square", tmp_path)
    table = squares(tmp_path, x=[1, 2, 3], bad=[3]).run(elsewhere)
    assert list(table["square"].dropna()) == [1, 4]
    assert os.getpid() not in set(table["process"].dropna())
    with pytest.raises(InputError, match=r"no_such:f, but the one at tcp.* says .*install"):
        elsewhere.require_ready("no_such:f", tmp_path)

    # Of another version, or where the folder is not.
    for answer, message in (
        (
            ("0.0.1", source_digest(), True),
            r"expected modeharvest .*, got 0\.0\.1 .*on the one at tcp",
        ),
        ((RELEASE, "0" * 64, True), r"expected modeharvest .*, got .* with 0{12} on the one"),
        ((RELEASE, source_digest(), False), "expected workers that can write to the folder"),
    ):
        monkeypatch.setattr(workers, "handshake", lambda function, mark, answer=answer: answer)
        with pytest.raises(InputError, match=message):
            elsewhere.require_ready("campaign_cases:square", tmp_path)
    monkeypatch.undo()

    # It dies in the fifth of eight cases.
    campaign = Campaign("campaign_cases:dies_later", grid({"x": 0}, x=list(range(8))), tmp_path)

    def hurry(done: float, total: float, what: str) -> None:
        if done == 4:  # from now on only its absence is waited for
            default_client()._timeout = 1.0
            monkeypatch.setattr(workers, "_PATIENCE_S", 1.0)
            (tmp_path / "go").touch()

    with pytest.raises(InputError, match="went away; 4 of 8 are done and kept"):
        campaign.run(elsewhere, hurry)
    assert len(campaign.missing()) == 4


def test_failures_are_recorded_and_only_what_is_missing_is_run_again(tmp_path: Path) -> None:
    campaign = squares(tmp_path, x=[1, 2, 3, 4, 5], bad=[3])
    table = campaign.run()
    assert list(table["x"]) == [1, 2, 3, 4, 5]
    assert list(table["square"].dropna()) == [1, 4, 16, 25]
    assert table["error"][2] == "ValueError: 3 is bad"
    assert "Traceback" in read_json(campaign.path(campaign.cases[2]))["error"]
    assert len(set(table["process"].dropna())) <= 2
    assert (tmp_path / "table.csv").read_text().count("\n") == 6
    assert campaign.missing() == (campaign.cases[2],)
    before = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "cases").iterdir()}

    # One case of them is asked for anew, by an option of its own.
    other = squares(tmp_path, x=[1, 2, 4, 5], bad=[3])
    other = Campaign(other.function, (*other.cases, {**BASE, "x": 6}), tmp_path)
    assert len(other.missing()) == 1
    assert other.run()["error"].eq("").all()
    after = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "cases").iterdir()}
    assert all(after[name] == stamp for name, stamp in before.items())


def test_results_of_another_version_are_named_and_not_mixed(tmp_path: Path) -> None:
    campaign = squares(tmp_path, x=[1])
    write_json(tmp_path / "cases" / "old.json", {"version": "0.0.0", "error": "", "result": {}})
    assert campaign.of_other_versions() == {"0.0.0": 1}
    assert campaign.table()["error"][0] == "not run"


def test_half_a_result_is_none(tmp_path: Path) -> None:
    campaign = squares(tmp_path, x=[1])
    path = campaign.path(campaign.cases[0])
    path.parent.mkdir()
    path.write_text('{"error": ""')
    assert campaign.missing() == campaign.cases


def test_a_worker_killed_costs_nothing(tmp_path: Path) -> None:
    cases = grid({"x": 0}, x=list(range(6)))
    campaign = Campaign("campaign_cases:dies_once", cases, tmp_path)
    table = campaign.run()
    assert (tmp_path / "died").exists()
    assert list(table["x_again"]) == list(range(6))
    assert table["error"].eq("").all()


def test_a_result_whose_worker_died_is_kept_and_no_lost_scheduler(tmp_path: Path) -> None:
    """A campaign that is slow to hear of a case while the worker that ran it dies."""
    cases = grid({"x": 0}, x=list(range(4)))
    campaign = Campaign("campaign_cases:dies_once", cases, tmp_path)

    def slow(done: float, total: float, what: str) -> None:
        """Look away from the first case on until dask says that another's result is lost."""
        while done == 1 and campaign.missing() and "lost" not in states():
            time.sleep(0.002)

    def states() -> set[str]:
        return {state.status for state in list(default_client().futures.values())}

    table = campaign.run(Workers(1), slow)
    assert table["error"].eq("").all()
    assert sorted((tmp_path / "runs").read_text().split()) == ["0", "1", "2", "2", "3"]


def test_a_connection_that_breaks_is_made_anew(tmp_path: Path) -> None:
    broken = []

    def cut(done: float, total: float, what: str) -> None:
        if done == 1 and not broken:
            client = default_client()
            client.loop.add_callback(client.scheduler_comm.comm.abort)
            broken.append(client)

    table = squares(tmp_path, x=[1, 2, 3, 4], wait=[0.1]).run(Workers(1), cut)
    assert broken
    assert list(table["square"]) == [1, 4, 9, 16]


def test_a_case_that_kills_every_worker_is_one_line_of_the_table(tmp_path: Path) -> None:
    campaign = Campaign("campaign_cases:dies", grid({"x": 0}, x=[3, 4, 5]), tmp_path)
    table = campaign.run()
    assert list(table["x_again"].dropna()) == [3, 5]
    assert table["error"][1] == (
        "KilledWorker: its workers died; it may need more memory than they are given"
    )


def test_a_case_is_not_blamed_for_what_ran_beside_it(tmp_path: Path) -> None:
    """Its worker is killed as often as dask allows, and then it is run alone."""
    cases = grid({"x": 0, "kills": 2}, x=[0, 1])
    table = Campaign("campaign_cases:duel", cases, tmp_path).run()
    assert table["error"].eq("").all()


def test_a_campaign_opens_nothing_beyond_this_machine(tmp_path: Path) -> None:
    cases = ({"x": os.getpid()},)
    (at,) = Campaign("campaign_cases:listening", cases, tmp_path).run(Workers(1))["at"]
    assert at, "dask's processes talk over TCP"
    assert set(at) == {"127.0.0.1"}


def half_done(folder: Path) -> Campaign:
    """Of eight cases, five end by themselves."""
    return Campaign("campaign_cases:holding", grid({"x": 0}, x=list(range(8))), folder)


def test_a_run_killed_goes_on_where_it_was(tmp_path: Path) -> None:
    program = textwrap.dedent(f"""
        import sys
        sys.path.insert(0, {str(Path(__file__).parent)!r})
        from pathlib import Path
        from test_campaign import half_done
        if __name__ == "__main__":
            half_done(Path({str(tmp_path)!r})).run()
    """)
    script = tmp_path / "run.py"
    script.write_text(program)
    run = subprocess.Popen([sys.executable, str(script)], start_new_session=True)
    campaign = half_done(tmp_path)
    while len(campaign.missing()) > 3:
        assert run.poll() is None
        time.sleep(0.02)
    os.killpg(run.pid, signal.SIGKILL)
    run.wait()
    finished = {path: path.read_bytes() for path in (tmp_path / "cases").glob("*.json")}
    assert len(campaign.missing()) == 3
    (tmp_path / "go").touch()
    assert campaign.run()["error"].eq("").all()
    assert all(path.read_bytes() == content for path, content in finished.items())


def test_nothing_is_collected_while_a_client_begins() -> None:
    """A client that failed closes when collected: within another's start that never ends."""
    assert not workers._begun(gc.isenabled)
    assert gc.isenabled()


def test_an_event_loop_that_is_slow_to_begin_is_begun_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As dask does it on a machine where a thread takes more than 10 s to run."""
    import distributed

    real, calls = distributed.LocalCluster, []

    def slow(*arguments: object, **options: object) -> object:
        calls.append(1)
        assert len(calls) > 2
        return real(*arguments, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(distributed, "LocalCluster", slow)
    assert list(squares(tmp_path, x=[2, 3]).run(Workers(1))["square"]) == [4, 9]
    assert len(calls) == 3

"""A small challenge from end to end: sealed, resumable, analysed blindly, and nobody looks at the answers."""

import hashlib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from pcw_sim_bridge.mismatch.__main__ import main
from pcw_sim_bridge.mismatch.challenge.cases import order_cases, prepare_case
from pcw_sim_bridge.mismatch.challenge.make import make
from pcw_sim_bridge.mismatch.challenge.run import run
from pcw_sim_bridge.mismatch.challenge.sealed_answers import HASH_FILE
from pcw_sim_bridge.mismatch.challenge.worker_processes import run_tasks
from pcw_sim_bridge.mismatch.errors import MismatchError

OPTIONS = {"kinds": ("none", "single"), "plants": ("reduced",), "durations": (15.0, 15.5)}
COUNT, SEED = 2, 6

# Analyses a case and tells every path that was opened or listed on the way.
WATCHED = """
import json, os, sys
seen = set()
def watch(event, arguments):
    if event in ("open", "os.listdir", "os.scandir") and isinstance(arguments[0], (str, bytes, os.PathLike)):
        seen.add(os.path.realpath(os.fsdecode(arguments[0])))
sys.addaudithook(watch)
from pathlib import Path
from pcw_sim_bridge.mismatch.challenge.run import analyse_case
analyse_case(Path(sys.argv[1]), Path(sys.argv[2]), False)
print(json.dumps(sorted(seen)))
"""


def quiet(message: str) -> None:
    pass


@pytest.fixture(scope="module")
def challenge(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("challenge") / "cases"
    assert make(folder, COUNT, SEED, quiet, workers=1, **OPTIONS) == []
    return folder


def answer_file(folder: Path) -> Path:
    return folder.with_name("cases.answers.json")


def test_answers_are_sealed(challenge: Path) -> None:
    content = answer_file(challenge).read_bytes()
    promise = challenge / HASH_FILE
    assert promise.read_text().split()[0] == hashlib.sha256(content).hexdigest()
    recordings = list(challenge.rglob("*.mcap"))
    assert len(recordings) >= 2 * COUNT
    assert all(promise.stat().st_mtime_ns < path.stat().st_mtime_ns for path in recordings)


@pytest.mark.parametrize("kind", ["none", pytest.param("single", marks=pytest.mark.nightly)])
def test_answers_are_what_the_seed_gives(challenge: Path, kind: str) -> None:
    answers = json.loads(answer_file(challenge).read_bytes())["cases"]
    [order] = [order for order in order_cases(COUNT, SEED, **OPTIONS) if order.kind == kind]  # type: ignore[arg-type]
    [answer] = [answer for answer in answers if answer["kind"] == kind]
    # In a worker, too: with other threads of linear algebra, last digits differ.
    [again] = run_tasks(prepare_case, [(order.name, (order,))], 1)
    assert json.loads(json.dumps(again.result)) == answer


def test_cases_hold_no_answers(challenge: Path) -> None:
    answers = json.loads(answer_file(challenge).read_text())["cases"]
    concealed = [effect["name"].encode() for answer in answers for effect in answer["effects"]]
    assert concealed
    for path in (p for p in challenge.rglob("*") if p.is_file()):
        content = path.read_bytes()
        for word in (*concealed, b"deviations", b"torque_constant_error", b'"kind"'):
            assert word not in content, path
    assert sorted(path.name for path in challenge.iterdir()) == [HASH_FILE, "case_0001", "case_0002"]
    assert {p.name for p in (challenge / "case_0001").iterdir()} == {"robot.yaml", "recordings", "holdout"}


def test_it_goes_on_where_it_was_interrupted(challenge: Path, tmp_path: Path) -> None:
    """A case that is whole is kept; one that is not there comes again, to the same bytes."""
    folder = tmp_path / "cases"
    shutil.copytree(challenge, folder)
    shutil.copy(answer_file(challenge), answer_file(folder))

    def data() -> dict[Path, bytes]:
        return {path.relative_to(folder): path.read_bytes() for path in sorted(folder.rglob("*.mcap"))}

    before, kept = data(), (folder / "case_0001" / "robot.yaml").stat().st_mtime_ns
    shutil.rmtree(folder / "case_0002")
    (folder / ".case_0002.part").mkdir()  # what an interruption leaves
    told: list[str] = []
    assert make(folder, COUNT, SEED, told.append, workers=1, **OPTIONS) == []
    assert data() == before
    assert (folder / "case_0001" / "robot.yaml").stat().st_mtime_ns == kept
    assert [message.split()[0] for message in told] == ["1", "case_0002"]
    with pytest.raises(MismatchError, match="was begun with"):
        make(folder, COUNT, SEED + 1, quiet, **OPTIONS)
    answer_file(folder).write_text(answer_file(folder).read_text() + " ")
    with pytest.raises(MismatchError, match="SHA-256"):
        make(folder, COUNT, SEED, quiet, **OPTIONS)
    answer_file(folder).unlink()
    with pytest.raises(MismatchError, match="answers are elsewhere"):
        make(folder, COUNT, SEED, quiet, **OPTIONS)
    with pytest.raises(MismatchError, match="is inside"):
        make(folder, COUNT, SEED, quiet, answers=folder / "answers.json", **OPTIONS)


def test_the_analysis_does_not_read_the_answers(challenge: Path, tmp_path: Path) -> None:
    """With the answers there, and with others in their place: the same findings, from the same files of the case alone."""
    folder = tmp_path / "cases"
    shutil.copytree(challenge, folder)
    shutil.copy(answer_file(challenge), answer_file(folder))
    (folder / "case_0002" / "robot.yaml").write_text("format: pcw_robot/1\nname: broken\n")
    told: list[str] = []
    assert run(folder, told.append, workers=1) == ["case_0002"]
    assert sum("failed" in message for message in told) == 1
    assert not (folder / "reports" / "case_0002").exists()
    usage = json.loads((folder / "reports" / "case_0001" / "usage.json").read_text())
    assert usage["seconds"] > 0.0 and usage["peak_bytes"] > 2**26

    answer_file(folder).write_text("poison")
    case, out = folder / "case_0001", tmp_path / "again"
    done = subprocess.run(
        [sys.executable, "-c", WATCHED, str(case), str(out)], capture_output=True, text=True, timeout=280, check=False,
        # With the threads of a worker: sums in another order differ in their last digits.
        env={**os.environ, "MPLCONFIGDIR": str(tmp_path / "again.config"), "OMP_NUM_THREADS": "1",
             "OPENBLAS_NUM_THREADS": "1"},
    )
    assert done.returncode == 0, done.stderr
    own = [case, out, tmp_path / ".again.part", tmp_path / "again.config"]
    opened = [Path(path) for path in json.loads(done.stdout)]
    assert any(path.is_relative_to(case / "holdout") for path in opened)
    others = [p for p in opened if p.is_relative_to(tmp_path) and p != tmp_path and not any(p.is_relative_to(o) for o in own)]
    assert others == []
    assert [p for p in opened if "answers" in p.name and p.suffix == ".json"] == []

    reports = [json.loads((place / "report.json").read_text()) for place in (folder / "reports" / "case_0001", out)]
    for report in reports:
        del report["seconds"]
    assert json.dumps(reports[0]) == json.dumps(reports[1])


def test_cases_that_are_not_recorded_yet_are_not_left_out_in_silence(tmp_path: Path) -> None:
    """A folder that was still being made was analysed as if it were whole."""
    said: list[str] = []
    case = tmp_path / "case_0001"
    case.mkdir()
    (case / "robot.yaml").write_text("format: none\n")
    run(tmp_path, said.append, workers=1)
    assert not any("not all cases" in line for line in said)
    (tmp_path / ".case_0002.part").mkdir()
    run(tmp_path, said.append, workers=1)
    assert "not all cases are recorded yet" in said[-2]


def test_baselines_without_what_they_need_are_told_before_any_analysis(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After minutes of the first case it was said that a package is missing."""
    monkeypatch.setattr("pcw_sim_bridge.mismatch.baselines.comparison_packages.MODULES", ("no_such_package",))
    with pytest.raises(MismatchError, match="no_such_package"):
        run(tmp_path, lambda message: None, baselines=True)


# Expressions, as a worker process can import `eval` and not a function of a test.
MISMATCH_ERROR = "__import__('pcw_sim_bridge.mismatch.errors', fromlist=['MismatchError']).MismatchError('no such thing')"
TASKS = {
    "a": "'aa'", "dies": "__import__('os')._exit(7)", "b": "'bb'", "fails": f"(_ for _ in ()).throw({MISMATCH_ERROR})",
    "c": "'cc'", "breaks": "1 / 0", "d": "'dd'",
}  # fmt: skip


def test_a_task_that_fails_or_dies_takes_no_other_with_it() -> None:
    names = list(TASKS)
    done = {d.name: d for d in run_tasks(eval, [(name, (text,)) for name, text in TASKS.items()], 2)}
    assert set(done) == set(names)
    assert [done[name].result for name in "abcd"] == ["aa", "bb", "cc", "dd"]
    assert done["dies"].error == "its process ended with code 7"
    assert done["fails"].error == "no such thing"
    assert done["breaks"].error == "ZeroDivisionError: division by zero"
    assert done["a"].peak_bytes > 2**20


def test_linear_algebra_leaves_the_cores_to_the_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("threadpoolctl")
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        monkeypatch.delenv(name, raising=False)
    asked = "[pool['num_threads'] for pool in __import__('threadpoolctl').threadpool_info()]"
    (done,) = run_tasks(eval, [("asked", (asked,))], 1)
    assert done.error == "" and set(done.result) == {1}


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["make", "--out", "{}/x", "--cases", "0", "--seed", "1"], "--cases 0"),
        (["make", "--out", "{}/x", "--cases", "1", "--seed", "1", "--kinds", "easy"], "'easy'"),
        (["make", "--out", "{}/x", "--cases", "1", "--seed", "1", "--workers", "0"], "--workers 0"),
        (["run", "{}/x"], "holds no case"),
        (["score", "{}/x", "--answers", "{}/y"], "No such file"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(
    arguments: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["challenge", *(argument.format(tmp_path) for argument in arguments)]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []

"""The `validate` command, and the documentation that it prints."""

from __future__ import annotations

import dataclasses
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

from pcw_description.description_fields import document, quantity, section, text
from pcw_description.effects.registry import all_effects, effects_text
from pcw_description.robot_description import DEFAULT_TOLERANCES
from pcw_description.robot_file import load_robot, robot_to_mapping, robots_directory, shipped_robots
from pcw_description.validate import keys_table, main, tolerances_table

README = Path(__file__).parents[1] / "README.md"


def keys_of(data: object, prefix: str = "") -> Iterator[str]:
    """Keys of a description as the table writes them; what is free text or has its own table stands under its parent."""
    for key, value in data.items() if isinstance(data, Mapping) else ():
        name = f"{prefix}{key}"
        yield name
        if name in ("provenance", "tolerances", "physics", "contact.shape"):
            continue
        if isinstance(value, list):
            for item in value:
                yield from keys_of(item, f"{name}[].")
        else:
            yield from keys_of(value, f"{name}.")


def test_shipped_robots_are_valid(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(list(shipped_robots())) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.partition(":")[0] for line in lines] == list(shipped_robots())
    assert "thesis: OK (4 casters, 90 kg)" in lines
    assert "mpo700: OK (4 casters, 195.6 kg; for kinematics and analysis only (b_x = 0))" in lines


def test_each_file_has_its_line_and_one_bad_one_fails_the_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bad = tmp_path / "bad.yaml"
    bad.write_text((robots_directory() / "thesis.yaml").read_text(encoding="utf-8").replace("mass: 74.0", "mass: -74.0"))
    assert main([str(bad), "thesis"]) == 2
    printed = capsys.readouterr()
    assert printed.out == "thesis: OK (4 casters, 90 kg)\n"
    message = "chassis.mass: -74.0 is not allowed; allowed: a number in kg, above 0, at most 100000"
    assert printed.err == f"{bad}: {message}\n"


def test_without_anything_to_do_it_says_so() -> None:
    with pytest.raises(SystemExit) as caught:
        main([])
    assert caught.value.code == 2


def test_it_runs_as_a_program() -> None:
    result = subprocess.run([sys.executable, "-m", "pcw_description.validate", "nothing"], capture_output=True, text=True)
    assert result.returncode == 2
    assert "shipped robot" in result.stderr and "Traceback" not in result.stderr


def test_readme_holds_what_the_command_prints(capsys: pytest.CaptureFixture[str]) -> None:
    """Run `validate --keys` and put its output between the two marks when this fails."""
    assert main(["--keys"]) == 0
    printed = capsys.readouterr().out.strip()
    blocks = re.findall(
        r"<!-- validate --keys: begin -->\n(.*?)\n<!-- validate --keys: end -->", README.read_text(encoding="utf-8"), re.DOTALL
    )
    assert blocks == [printed]
    assert printed == f"{keys_table()}\n\n{tolerances_table()}"


def test_example_of_the_readme_runs() -> None:
    example, *_ = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
    names: dict[str, object] = {}
    exec(example, names)  # noqa: S102 - our own text
    assert names["inertia"].shape == (3, 3) and names["joint_velocity"].shape == (4, 2)  # type: ignore[attr-defined]


def test_table_names_every_key_once() -> None:
    keys = re.findall(r"^\| ([\w.\[\]]+) \|", keys_table(), re.MULTILINE)
    assert len(keys) == len(set(keys))
    deep = {"casters[].gears.drive_per_steer", "contact.lateral.mu_p", "sensors.imu.rate"}
    assert {"format", "caster_defaults", "physics"} | deep <= set(keys)
    for name in shipped_robots():
        used = set(keys_of(robot_to_mapping(load_robot(name))))
        assert used <= set(keys), used - set(keys)
    assert not [key for key in keys if key.startswith("physics[]")], "the parameters of an effect are its own"


def test_tables_of_tolerances_and_effects_are_complete() -> None:
    for name, tolerance in DEFAULT_TOLERANCES.items():
        assert f"| {name} | {tolerance} |" in tolerances_table()
    for effect in all_effects().values():
        assert f"{effect.name} ({effect.target_kind}" in effects_text()
        for parameter in effect.parameters:
            assert f"{parameter.name} [{parameter.unit}]" in effects_text()


def test_documentation_follows_from_the_declaration() -> None:
    @dataclasses.dataclass(frozen=True)
    class Part:
        length: float = quantity("m", "how long", above=0.0)

    # The module's namespace is where dataclass annotations are looked up.
    globals()["Part"] = Part

    @dataclasses.dataclass(frozen=True)
    class Thing:
        colour: str = text("its colour", choices=("red", "blue"))
        parts: tuple[Part, ...] = section("its parts")
        weight: float | None = quantity("kg", "how heavy", default=None)
        age: float = quantity("1", "how old", minimum=0.0, default=3.0)

    try:
        rows = document(Thing)
    finally:
        del globals()["Part"]
    assert rows == [
        ("colour", "", "red, blue", "its colour"),
        ("parts", "", "", "its parts"),
        ("parts[].length", "m", "a number in m, above 0", "how long"),
        ("weight", "kg", "a number in kg; optional", "how heavy"),
        ("age", "1", "a number, at least 0; default 3", "how old"),
    ]

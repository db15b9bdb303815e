"""The rate of nodes in one process is measured and never judged by the exit status."""

import re

import pytest

pytest.importorskip("rclpy")

from pcw_bringup_scripts import composed_rate  # noqa: E402


@pytest.mark.nightly  # a whole robot for some seconds
def test_it_counts_readings_and_answers(capsys):
    assert composed_rate.main(["--duration", "2"]) == 0
    said = capsys.readouterr().out
    assert "bridge, computed_torque, odometry, slip_observer, terrain; robot thesis, encoders at 500 Hz" in said
    rates = [float(rate) for rate in re.findall(r"^\S+ +([\d.]+) Hz", said, flags=re.MULTILINE)]
    assert len(rates) == 2 and all(10.0 < rate < 600.0 for rate in rates)  # whatever else this computer does
    assert re.search(r"median \d+\.\d\d ms, 99 % \d+\.\d\d ms", said) and re.search(r"500 Hz (held|NOT held)", said)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(["bridge", "terain"], "allowed: bridge"), (["terrain"], "allowed: bridge"), (["--duration", "0"], "1 to 3600")],
)
def test_bad_input_ends_with_status_2(arguments, message, capsys):
    with pytest.raises(SystemExit) as end:
        composed_rate.main(arguments)
    assert end.value.code == 2 and message in capsys.readouterr().err

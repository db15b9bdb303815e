"""Runs several nodes in one process and one events executor: the cheapest way to run a robot's nodes on one computer.

    compose bridge computed_torque odometry encoder_slip --ros-args -p computed_torque:goal_speed:=0.3 -p robot:=thesis
    compose bridge computed_torque --help      the parameters of these nodes

Parameters without a node's name go to all nodes (`-p robot:=thesis`); with it, to that one.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Sequence

from pcw_description.errors import nearest_name

# What can be composed: name on the command line -> module and class.
NODES = {
    "bridge": ("pcw_sim_bridge.nodes.bridge", "BridgeNode"),
    "computed_torque": ("pcw_control.nodes.computed_torque", "ComputedTorqueNode"),
    "controller": ("pcw_control.nodes.controller", "ControllerNode"),
    "encoder_slip": ("pcw_estimation.nodes.encoder_slip", "EncoderSlipNode"),
    "ground_test_controller": ("pcw_sim_bridge.nodes.ground_test_controller", "GroundTestControllerNode"),
    "imu_slip": ("pcw_estimation.nodes.imu_slip", "ImuSlipNode"),
    "markers": ("pcw_sim_bridge.nodes.markers", "MarkersNode"),
    "mismatch_monitor": ("pcw_sim_bridge.nodes.mismatch_monitor", "MismatchMonitorNode"),
    "odometry": ("pcw_estimation.nodes.odometry", "OdometryNode"),
    "recorder": ("pcw_sim_bridge.nodes.recorder", "RecorderNode"),
    "robot_description": ("pcw_description.nodes.robot_description", "RobotDescriptionNode"),
    "slip_observer": ("pcw_estimation.nodes.slip_observer", "SlipObserverNode"),
    "slip_fusion": ("pcw_estimation.nodes.slip_fusion", "SlipFusionNode"),
    "terrain": ("pcw_terrain.nodes.terrain", "TerrainNode"),
    "transforms": ("pcw_description.nodes.transforms", "TransformsNode"),
}


def node_factories(names: Sequence[str]) -> list[Callable[[], object]]:
    """Return what makes each node; the modules are imported here, so that nodes left out cost nothing.

    Raises:
        ValueError: an unknown name, or one given twice.
    """
    for index, name in enumerate(names):
        if name not in NODES:
            raise ValueError(f"node {name!r} is not known; {nearest_name(name, NODES)}")
        if name in names[:index]:
            raise ValueError(f"node {name!r} is given twice; allowed: each node once")
    return [getattr(importlib.import_module(NODES[name][0]), NODES[name][1]) for name in names]


def main(args: Sequence[str] | None = None) -> int:
    """Compose the nodes named before --ros-args."""
    arguments = list(sys.argv[1:] if args is None else args)
    split = arguments.index("--ros-args") if "--ros-args" in arguments else len(arguments)
    names, ros_arguments = arguments[:split], arguments[split:]
    wants_help = any(argument in ("-h", "--help") for argument in arguments)
    if wants_help:
        names = [name for name in names if name not in ("-h", "--help")]
    if not names:
        print(f"{__doc__.strip()}\n\nNodes: {', '.join(NODES)}", file=sys.stdout if wants_help else sys.stderr)
        return 0 if wants_help else 2
    try:
        factories = node_factories(names)
    except ValueError as error:
        print(f"compose: {error}", file=sys.stderr)
        return 2
    if wants_help:
        from pcw_description.nodes.node_help import HOW_TO_GIVE, parameter_table

        print("\n\n".join([HOW_TO_GIVE, *(f"{name}\n{parameter_table(node)}" for name, node in zip(names, factories))]))
        return 0
    from pcw_description.nodes.node_tools import run_nodes

    return run_nodes(factories, ros_arguments)


if __name__ == "__main__":
    raise SystemExit(main())

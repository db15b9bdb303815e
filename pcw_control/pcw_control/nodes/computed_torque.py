"""The controller node under the name that it had when computed torque was all there was, for programs that start it so."""

from __future__ import annotations

from collections.abc import Sequence

from pcw_description.nodes.node_tools import run_node

from .controller import ControllerNode


class ComputedTorqueNode(ControllerNode):
    """`ControllerNode`, named `computed_torque`."""

    def __init__(self) -> None:
        super().__init__("computed_torque")


def main(args: Sequence[str] | None = None) -> int:
    """Run the controller."""
    return run_node(ComputedTorqueNode, args)


if __name__ == "__main__":
    raise SystemExit(main())

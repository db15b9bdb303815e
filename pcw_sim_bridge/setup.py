"""Standard ament_python build of pcw_sim_bridge."""

from glob import glob
from os.path import dirname, isfile, join

from setuptools import find_packages, setup

package_name = "pcw_sim_bridge"


def share_files(folder):
    """Return data_files entries that install `folder`, sub-folders included, under share/<package>."""
    by_folder = {}
    for path in sorted(glob(join(folder, "**", "*"), recursive=True)):
        if isfile(path) and "__pycache__" not in path:
            by_folder.setdefault(join("share", package_name, dirname(path)), []).append(path)
    return sorted(by_folder.items())


setup(
    name=package_name,
    version="0.1.0",
    packages=find_packages(exclude=["test", "test.*", "tests", "tests.*"]),
    package_data={"": ["*.css", "*.dbc", "*.html", "*.j2", "*.js", "*.svg", "*.yaml", "py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/" + package_name]),
        ("share/" + package_name, ["package.xml"]),
        *share_files("config"),
        *share_files("launch"),
    ],
    python_requires=">=3.11",
    install_requires=["setuptools"],
    extras_require={
        "test": ["pytest"],
        "distributed": ["distributed>=2022.2.0"],  # a Dask cluster for mismatch fleet
        "mujoco": ["mujoco>=3.3.1"],  # the first with armature on tendons, which the rotors are
    },
    zip_safe=False,
    maintainer="PCW maintainers",
    maintainer_email="pcw-maintainers@example.org",
    description=(
        "Simulated plants, bridge and recorder nodes, and the mismatch analyser for powered-caster "
        "robots."
    ),
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "bridge = pcw_sim_bridge.nodes.bridge:main",
            "can_doctor = pcw_sim_bridge.can.can_doctor:main",
            "can_driver = pcw_sim_bridge.nodes.can_driver:main",
            "can_log = pcw_sim_bridge.can.can_log:main",
            "can_steer_zero = pcw_sim_bridge.can.can_steer_zero:main",
            "drive_emulator = pcw_sim_bridge.can.drive_emulator:main",
            "ground_test_controller = pcw_sim_bridge.nodes.ground_test_controller:main",
            "markers = pcw_sim_bridge.nodes.markers:main",
            "mismatch = pcw_sim_bridge.mismatch.__main__:main",
            "mismatch_monitor = pcw_sim_bridge.nodes.mismatch_monitor:main",
            "recorder = pcw_sim_bridge.nodes.recorder:main",
            "simulate = pcw_sim_bridge.simulate:main",
        ],
    },
)

"""Standard ament_python build of pcw_bringup_scripts."""

from glob import glob
from os.path import dirname, isfile, join

from setuptools import find_packages, setup

package_name = "pcw_bringup_scripts"


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
    package_data={"": ["*.css", "*.html", "*.j2", "*.js", "*.svg", "*.yaml", "py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/" + package_name]),
        ("share/" + package_name, ["package.xml"]),
        *share_files("config"),
        *share_files("launch"),
    ],
    python_requires=">=3.11",
    install_requires=["setuptools"],
    extras_require={"test": ["pytest"]},
    zip_safe=False,
    maintainer="PCW maintainers",
    maintainer_email="pcw-maintainers@example.org",
    description="Set-up, demonstration, tests, launch files and benchmarks of the PCW packages.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "benchmark = pcw_bringup_scripts.benchmark:main",
            "compose = pcw_bringup_scripts.compose:main",
            "composed_rate = pcw_bringup_scripts.composed_rate:main",
            "demo_run = pcw_bringup_scripts.demo_run:main",
            "manoeuvre = pcw_bringup_scripts.nodes.manoeuvre:main",
        ],
    },
)

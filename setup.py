"""How colcon builds rsltrace in a ROS 2 workspace. Everybody else builds from pyproject.toml alone.

colcon asks for a setup.py; this one takes what it says from pyproject.toml, which the setuptools of
ROS 2's distributions are too old to read themselves.
"""

import runpy
from pathlib import Path

from setuptools import Distribution, find_packages, setup

try:
    import tomllib
except ModuleNotFoundError:  # Python 3.10
    import tomli as tomllib

ROOT = Path(__file__).resolve().parent
PACKAGES = {"rsltrace": ".", "rsltrace_viewer": "viewer"}
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]


class Checkout(Distribution):
    """A distribution that is described here alone."""

    def parse_config_files(self, *args, **more):
        """Leave pyproject.toml alone."""


def data_of(package):
    """Return the files of a package that are not modules, relative to it."""
    folder = ROOT / PACKAGES[package] / package
    files = (path for path in folder.rglob("*") if path.is_file())
    return [str(p.relative_to(folder)) for p in files if p.suffix not in (".py", ".pyc")]


setup(
    distclass=Checkout,
    name=PROJECT["name"],
    version=runpy.run_path(str(ROOT / "rsltrace" / "_version.py"))["__version__"],
    description=PROJECT["description"],
    license=PROJECT["license"],
    python_requires=PROJECT["requires-python"],
    install_requires=PROJECT["dependencies"],
    extras_require=PROJECT["optional-dependencies"],
    packages=[
        name
        for package, folder in PACKAGES.items()
        for name in find_packages(str(ROOT / folder), include=[package, f"{package}.*"])
    ],
    package_dir={"rsltrace_viewer": "viewer/rsltrace_viewer"},
    package_data={package: data_of(package) for package in PACKAGES},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/rsltrace"]),
        ("share/rsltrace", ["package.xml"]),
        ("share/man/man1", sorted(str(p.relative_to(ROOT)) for p in ROOT.glob("man/*.1"))),
    ],
    entry_points={
        "console_scripts": [f"{name} = {at}" for name, at in PROJECT["scripts"].items()],
        **{
            group: [f"{name} = {at}" for name, at in entries.items()]
            for group, entries in PROJECT["entry-points"].items()
        },
    },
    zip_safe=False,
)

"""Make a Python environment with ROS 2 from wheels, and build the project's messages in it.

    python tools/ros_environment.py [FOLDER [DISTRIBUTION]]

FOLDER (default `.ros`) becomes a virtual environment in which `import rclpy`, `caryatid_msgs` and `caryatid`
work; it also sees the packages of the environment that runs this tool. DISTRIBUTION is jazzy or kilted. What
is up to date is kept. Needed are cmake, ninja and a C++ compiler; nothing is installed outside FOLDER.
"""

from __future__ import annotations

import hashlib
import os
import re
import subprocess
import sys
import sysconfig
import tomllib
from collections.abc import Mapping
from pathlib import Path

ROOT = Path(__file__).parents[1]
TESTS = ROOT / "tests/ros"
RUN = (
    "rclpy", "rmw-fastrtps-cpp", "std-msgs", "geometry-msgs", "sensor-msgs", "visualization-msgs",
    "diagnostic-msgs", "shape-msgs", "std-srvs", "trajectory-msgs",
)  # fmt: skip
"""Wheels that the node and its tests import."""
BUILD = (
    "rosidl-default-generators", "rosidl-core-generators", "ament-cmake", "ament-cmake-gen-version-h",
    "ament-cmake-gmock", "ament-cmake-gtest", "ament-cmake-include-directories", "ament-cmake-libraries",
    "ament-cmake-pytest", "ament-cmake-python", "ament-cmake-ros", "ament-cmake-test", "ament-cmake-version",
    "ament-package", "domain-coordinator", "gmock-vendor", "gtest-vendor", "python-cmake-module",
)  # fmt: skip
"""Wheels that building messages needs; those above do not name them all."""
PREFIXES = {"jazzy": "ros-jazzy-", "kilted": "ros-"}
"""How the names of a distribution's wheels begin."""
CMAKE = """cmake_minimum_required(VERSION 3.8)
project({name})
find_package(ament_cmake REQUIRED)
find_package(rosidl_default_generators REQUIRED)
foreach(needed {needed})
  find_package(${{needed}} REQUIRED)
endforeach()
rosidl_generate_interfaces(${{PROJECT_NAME}} {interfaces} DEPENDENCIES {needed})
ament_export_dependencies(rosidl_default_runtime)
ament_package()
"""
PACKAGE = """<package format="3">
  <name>{name}</name>
  <version>0.0.0</version>
  <description>Messages for tests.</description>
  <maintainer email="nobody@caryatid.invalid">the caryatid authors</maintainer>
  <license>BSD-3-Clause</license>
  <member_of_group>rosidl_interface_packages</member_of_group>
  <export><build_type>ament_cmake</build_type></export>
</package>
"""
"""Files of a package of messages that no wheel has."""


def main(folder: str | Path = ROOT / ".ros", distribution: str = "jazzy") -> None:
    """Make or update the environment.

    Raises:
        SystemExit: A wheel, or a tool that builds, is missing.
    """
    folder = Path(folder).resolve()
    own, missing = ROOT / "ros/caryatid_msgs", TESTS / "interfaces.toml"
    wanted = hashlib.sha256((sys.version + distribution).encode())
    for file in (Path(__file__), missing, *sorted(file for file in own.rglob("*") if file.is_file())):
        wanted.update(file.read_bytes())
    stamp = folder / "stamp"
    if stamp.exists() and stamp.read_text() == wanted.hexdigest():
        return
    python = folder / "bin/python"
    _run(sys.executable, "-m", "venv", "--clear", folder)
    more = ("ament-cmake-ros-core",) if distribution == "kilted" else ()
    wheels = [PREFIXES[distribution] + name for name in (*RUN, *BUILD, *more)]
    others = "catkin_pkg", "numpy", "py-trees"
    _run(python, "-m", "pip", "install", "-q", "-c", ROOT / "constraints.txt", *wheels, *others)
    site = Path(sysconfig.get_path("purelib", vars={"base": str(folder)}))
    # The wheels name the include folders of the machine that built them.
    version = f"{sys.version_info.major}{sys.version_info.minor}"
    theirs = f"/opt/python/cp{version}-cp{version}/"
    numpy = f"{theirs}lib/python{sys.version_info.major}.{sys.version_info.minor}/site-packages/numpy"
    for file in (folder / "share").rglob("*Export.cmake"):
        text = file.read_text()
        if theirs in text:
            text = text.replace(numpy, str(site / "numpy"))
            include = f"{theirs}include/python{sys.version_info.major}.{sys.version_info.minor}"
            file.write_text(text.replace(include, sysconfig.get_path("include")))
    libraries = os.pathsep.join(map(str, [folder / "lib", *site.glob("ros_*.libs")]))
    environment = os.environ | {
        "PATH": f"{folder / 'bin'}{os.pathsep}{os.environ['PATH']}",
        "AMENT_PREFIX_PATH": str(folder),
        "CMAKE_PREFIX_PATH": str(folder),
        "LD_LIBRARY_PATH": libraries,
        "PYTHONPATH": str(site),
    }
    packages = tomllib.loads(missing.read_text()).items()
    for package in (own, *(_write_package(folder / "source" / name, files) for name, files in packages)):
        build = folder / "build" / package.name
        options = [f"-DCMAKE_INSTALL_PREFIX={folder}", "-DCMAKE_BUILD_TYPE=Debug", "-DBUILD_TESTING=OFF"]
        options += ["-DCMAKE_CXX_FLAGS=-O0", f"-DPython3_EXECUTABLE={python}", "-Wno-dev", "-G", "Ninja"]
        _run("cmake", "-S", package, "-B", build, *options, environment=environment)
        _run("cmake", "--build", build, "--target", "install", environment=environment)
    # Behind the packages of ROS: those of the project, the node, and what no wheel has.
    paths = [ROOT / "src", ROOT / "ros/caryatid_ros", TESTS / "stand_ins", sysconfig.get_path("purelib")]
    (site / "zz_caryatid.pth").write_text("".join(f"{path}\n" for path in paths))
    stamp.write_text(wanted.hexdigest())


def _write_package(folder: Path, interfaces: Mapping[str, str]) -> Path:
    """Write a package of messages."""
    names = {name for fields in interfaces.values() for name in re.findall(r"(\w+)/\w", fields)}
    texts = {"name": folder.name, "needed": " ".join(sorted(names - {folder.name}))}
    files = {
        "CMakeLists.txt": CMAKE.format(interfaces=" ".join(interfaces), **texts),
        "package.xml": PACKAGE.format(**texts),
    }
    for name, text in (files | dict(interfaces)).items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder


def _run(*command: object, environment: dict[str, str] | None = None) -> None:
    done = subprocess.run(list(map(str, command)), env=environment, text=True, capture_output=True)
    if done.returncode:
        sys.exit(f"{' '.join(map(str, command))}\n{done.stdout[-4000:]}{done.stderr[-4000:]}")


if __name__ == "__main__":
    main(*sys.argv[1:])

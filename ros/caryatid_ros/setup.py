"""How colcon builds the package."""

from setuptools import setup

NAME = "caryatid_ros"

setup(
    name=NAME,
    version="0.2.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/explore.launch.py", "launch/params.yaml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    maintainer="the caryatid authors",
    maintainer_email="nobody@caryatid.invalid",
    description="A ROS 2 node that explores a cluttered table with caryatid.",
    license="BSD-3-Clause",
    entry_points={"console_scripts": [f"explore = {NAME}.node:main"]},
)

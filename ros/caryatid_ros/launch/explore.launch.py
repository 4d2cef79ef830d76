"""Start the node: `ros2 launch caryatid_ros explore.launch.py params:=FILE`."""

from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription


def generate_launch_description():
    """Describe the launch: one node, `caryatid`, with a file of parameters."""
    defaults = PathJoinSubstitution([FindPackageShare("caryatid_ros"), "launch", "params.yaml"])
    params = DeclareLaunchArgument("params", default_value=defaults, description="File of parameters.")
    node = Node(
        package="caryatid_ros", executable="explore", name="caryatid", output="screen",
        parameters=[LaunchConfiguration("params")],
    )  # fmt: skip
    return LaunchDescription([params, node])

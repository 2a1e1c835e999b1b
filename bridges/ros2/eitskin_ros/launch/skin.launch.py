"""ros2 launch eitskin_ros skin.launch.py skins:=palm,sole namespace:=left: a node for each skin, named as it is."""

from eitskin_ros.messages import ros_name
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def nodes(context):
    given = {name: LaunchConfiguration(name).perform(context) for name in ("skins", "namespace", "params_file")}
    files = [given["params_file"]] if given["params_file"] else []
    return [
        Node(
            package="eitskin_ros",
            executable="skin",
            name=ros_name(skin),
            namespace=given["namespace"],
            parameters=[{"skin": skin}, *files],
            output="screen",
        )
        for skin in given["skins"].replace(",", " ").split()
    ]


def generate_launch_description():
    return LaunchDescription(
        [
            DeclareLaunchArgument("skins", default_value="palm", description="as in skin.toml, with commas between"),
            DeclareLaunchArgument("namespace", default_value="", description="of all the nodes"),
            DeclareLaunchArgument("params_file", default_value="", description="further parameters, a YAML file"),
            OpaqueFunction(function=nodes),
        ]
    )

"""A node of ROS 2 that says where a robot stands: sweeps are registered on a map, sure answers go out as tf.

    python examples/ros2_node.py --ros-args -p map:=map.pcd -p cloud:=/lidar/points

geomoe3d depends on nothing of ROS; this file needs a sourced ROS 2 with rclpy, sensor_msgs_py and tf2_ros. Answers
that are not sure are named in the log and published nowhere.
"""

import numpy as np
from scipy.spatial.transform import Rotation

import geomoe3d


class Localiser:
    """The part without ROS: a map kept in memory, one sweep at a time.

    Args:
        world: anything that `geomoe3d.load_points` takes.
        least_confidence: of an answer that is believed, besides its status.
    """

    def __init__(self, world, least_confidence=0.95, config=None):
        self.registrar = geomoe3d.Registrar(config)
        self.world = geomoe3d.load_points(world, name="map")
        self.least_confidence = least_confidence

    def locate(self, points):
        """Translation (3,) and quaternion (4,), xyzw, of the sensor in the map, or None; and the result."""
        result = self.registrar.register(points, self.world)
        if not (result.ok and result.confidence >= self.least_confidence):
            return None, result
        T = result.T_target_source
        return (T[:3, 3], Rotation.from_matrix(T[:3, :3]).as_quat()), result


def main():
    import rclpy
    from geometry_msgs.msg import TransformStamped
    from rclpy.node import Node
    from sensor_msgs.msg import PointCloud2
    from sensor_msgs_py.point_cloud2 import read_points_numpy
    from tf2_ros import TransformBroadcaster

    rclpy.init()
    node = Node("geomoe3d")
    localiser = Localiser(node.declare_parameter("map", "map.pcd").value)
    frame = node.declare_parameter("frame", "map").value
    broadcaster = TransformBroadcaster(node)

    def on_cloud(message):
        points = read_points_numpy(message, field_names=("x", "y", "z")).astype(np.float64)
        pose, result = localiser.locate(points)
        if pose is None:
            node.get_logger().warning(f"not sure: {result!r}")
            return
        out = TransformStamped()
        out.header.stamp, out.header.frame_id = message.header.stamp, frame
        out.child_frame_id = message.header.frame_id
        place, turn = out.transform.translation, out.transform.rotation
        (place.x, place.y, place.z), (turn.x, turn.y, turn.z, turn.w) = (map(float, part) for part in pose)
        broadcaster.sendTransform(out)

    # A queue of one: while a sweep is being registered, older ones are of no use.
    node.create_subscription(PointCloud2, node.declare_parameter("cloud", "/points").value, on_cloud, 1)
    rclpy.spin(node)


if __name__ == "__main__":
    main()

"""ROS 2 bags, read and written by the package rosbags."""

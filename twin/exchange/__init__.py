"""Files of other programs: maps, meshes and point clouds, pose graphs, data sets, calibrations and ROS 2 bags."""

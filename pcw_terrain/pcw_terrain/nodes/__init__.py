"""ROS nodes of pcw_terrain: thin layers over the cores."""

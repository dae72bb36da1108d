"""Recordings of other systems: ROS 1 and ROS 2 bags, Foxglove MCAP; their topics as streams, and the way out again."""

"""Operators for robot perception."""

MOVED_OPERATORS = {
    "operators.cloud.scan_watch:ScanWatch": "operators.monitoring:ScanWatch",
    "operators.cloud:ScanWatch": "operators.monitoring:ScanWatch",
    "operators.crosscheck.color_depth_check:ColorDepthCheck": "operators.monitoring:ColorDepthCheck",
    "operators.crosscheck.depth_scan_check:DepthScanCheck": "operators.monitoring:DepthScanCheck",
    "operators.crosscheck.motion_check:MotionCheck": "operators.monitoring:MotionCheck",
    "operators.crosscheck:ColorDepthCheck": "operators.monitoring:ColorDepthCheck",
    "operators.crosscheck:DepthScanCheck": "operators.monitoring:DepthScanCheck",
    "operators.crosscheck:MotionCheck": "operators.monitoring:MotionCheck",
    "operators.image.watch:DepthWatch": "operators.monitoring:DepthWatch",
    "operators.image.watch:ImageWatch": "operators.monitoring:ImageWatch",
    "operators.image:DepthWatch": "operators.monitoring:DepthWatch",
    "operators.image:ImageWatch": "operators.monitoring:ImageWatch",
    "operators.odometry.lidar_odometry:LidarOdometry": "operators.odometry:LidarOdometry",
    "operators.odometry.mono_visual_odometry:MonoVisualOdometry": "operators.odometry:MonoVisualOdometry",
    "operators.odometry.stereo_visual_odometry:StereoVisualOdometry": "operators.odometry:StereoVisualOdometry",
    "operators.odometry.visual_odometry:VisualOdometry": "operators.odometry:VisualOdometry",
    "operators.odometry.wheel_odometry:WheelOdometry": "operators.odometry:WheelOdometry",
    "operators.sources.simulated_robot:SimulatedRobot": "operators.simulator:SimulatedRobot",
    "operators.sources:SimulatedRobot": "operators.simulator:SimulatedRobot",
}
"""Former path → present path, for graphs and recordings; graphs built in Python name the module of the class."""

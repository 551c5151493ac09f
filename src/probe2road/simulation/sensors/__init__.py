"""What vehicles measure: GNSS, odometry, cameras."""

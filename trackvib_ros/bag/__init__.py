"""MCAP bags: write, read, recover, inspect; no rclpy."""

"""splatbot as ROS programs see it: topics and services over rosbridge and Foxglove, and recordings; without ROS."""

"""ROS 2 without ROS: topics of the DDS wire that ROS 2 nodes read as if another node had sent them."""

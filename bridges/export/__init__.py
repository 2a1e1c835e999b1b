"""Recordings in the formats of others: Foxglove, ROS 2, tables, rerun. The same rules as live: of what is not valid
only that it was not is handed on.
"""

"""Processes that show contacts or hand them on to other worlds: the live page, Foxglove; recordings in the formats of
others; and ros2, a colcon workspace, whose node needs of us the wheel `eitskin` alone.

A bridge is an ordinary client of the service: it imports `protocol` alone, subscribes only to what somebody on its
other side wants, and nothing ever waits for it.
"""

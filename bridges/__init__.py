"""Processes that show contacts or hand them on to other worlds: the live page, ROS 2, Foxglove; and recordings in their
formats.

A bridge is an ordinary client of the service: it imports `protocol` alone, subscribes only to what somebody on its
other side wants, and nothing ever waits for it.
"""

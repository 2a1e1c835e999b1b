"""What crosses a process or a wire: frames, topics, sockets, the board link, and the client for controllers.

Needs numpy, pyzmq and msgpack only. WIRE.md documents every byte of it.
"""

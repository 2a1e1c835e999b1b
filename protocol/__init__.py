"""What crosses a process or a wire: frames, topics, sockets, the board link, and the client for controllers.

Needs numpy, pyzmq and msgpack only. WIRE.md documents every byte of it. Where to look:

    client.py, listener.py, aio.py     for a robot controller: the newest contacts, never old ones; callbacks; asyncio
    freshness.py, ages.py              what is new enough, and valid, to be acted on; how old a frame is
    topics.py, frame_types.py          the table of topics; the frames' fields with types, ranges and units
    frames.py, fields.py, records.py   frames as messages and back, checked
    held.py                            the image that held frames stand for
    sockets.py, control.py             publishing, reading, commands
    runtime.py, transport.py           where the sockets are, whose they are, TCP and keys
    link.py, link_messages.py          the board's serial link (with cobs.py and ad5940.py)
    wire_doc.py                        prints WIRE.md's tables
"""

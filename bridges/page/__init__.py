"""The live page: the skin in a browser, pressed there where it is the stub's. `python -m bridges.page SETTINGS`"""

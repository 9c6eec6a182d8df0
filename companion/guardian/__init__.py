"""The guardian: a standby process that lands the vehicle when the flight process hangs or dies.

`process` runs as `python -m companion.guardian`; `client` is the flight process's side. The guardian imports neither asyncio, numpy,
pydantic nor MAVSDK: it is small, starts fast and shares with the flight process little code that could fail in both.
"""

"""The guardian: a standby process that lands the vehicle when the flight process hangs or dies.

`process` runs as `python -m companion.guardian`; `client` is the flight process's side. The guardian imports neither asyncio, numpy,
pydantic nor MAVSDK: it stays small, starts fast and shares little code with the flight that could fail in both.
"""

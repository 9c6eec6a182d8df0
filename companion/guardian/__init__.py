"""The guardian: a hot standby that lands the vehicle when the flight process hangs or dies.

`process` is what runs as `python -m companion.guardian`; `client` is the flight process's side. The guardian imports no more than it
needs (no asyncio, numpy, pydantic or MAVSDK), so that it is small, starts at once and shares little that could fail with the flight.
"""

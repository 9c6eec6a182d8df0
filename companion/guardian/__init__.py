"""The guardian: a standby process that lands the vehicle when the flight process hangs or dies.

`process` runs as `python -m companion.guardian`; `client` is the flight process's side. The guardian does not import asyncio,
numpy, pydantic or MAVSDK: it is small, starts fast, and shares little code with the flight process, so that few errors can affect
both.
"""

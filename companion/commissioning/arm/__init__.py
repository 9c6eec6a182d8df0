"""Commissioning of the arm. `tools` runs `companion arm scan|setup|zero|jog|friction|reboot`; `bus` accesses registers of any servo."""

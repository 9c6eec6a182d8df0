"""Commissioning of the arm. `tools` runs `companion arm scan|setup|zero|jog|friction`; `bus` accesses the registers of any servo."""

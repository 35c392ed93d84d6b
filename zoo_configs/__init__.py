"""Agents, a file each: package ``sb3_cpm.zoo_configs`` where sb3_cpm is installed. Read by :mod:`sb3_cpm.agents`."""

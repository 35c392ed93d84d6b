from setuptools import setup

setup()  # everything is in setup.cfg; this file serves tools that look for it

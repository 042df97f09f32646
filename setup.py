"""For colcon, which builds ament_python packages with setup.py; everything is in pyproject.toml."""

from setuptools import setup

distribution = setup()
# colcon reads the attributes back as Python literals
distribution.python_requires = str(distribution.python_requires)
distribution.metadata.python_requires = distribution.python_requires

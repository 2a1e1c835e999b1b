from glob import glob

from setuptools import setup

SHARE = "share/eitskin_ros"
setup(
    name="eitskin_ros",
    version="0.2.0",
    packages=["eitskin_ros"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/eitskin_ros"]),
        (SHARE, ["package.xml"]),
        *((f"{SHARE}/{folder}", glob(f"{folder}/*.*")) for folder in ("launch", "rviz", "urdf")),
    ],
    license="Apache-2.0",
    entry_points={"console_scripts": ["skin = eitskin_ros.main:main", "admittance = eitskin_ros.admittance:main"]},
)

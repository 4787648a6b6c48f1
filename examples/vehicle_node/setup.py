from glob import glob

from setuptools import setup

NAME = "mapvote_vehicle"
setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/config", glob("config/*")),
        (f"share/{NAME}/schema", glob("schema/*")),
        (f"share/{NAME}/launch", glob("launch/*")),
    ],
    install_requires=["setuptools", "mapvote[ros]"],
    entry_points={"console_scripts": [f"mapvote_vehicle_node = {NAME}.node:main"]},
)

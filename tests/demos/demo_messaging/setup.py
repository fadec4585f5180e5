from setuptools import setup

setup(
    name="demo_messaging",
    version="1.0.0",
    description="Topics and parameters, as ordinary programs.",
    packages=["demo_messaging"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/demo_messaging"]),
        ("share/demo_messaging", ["package.xml"]),
    ],
    entry_points={
        "console_scripts": [
            "talker = demo_messaging.talker:main",
            "listener = demo_messaging.listener:main",
            "thermostat = demo_messaging.thermostat:main",
            "thermostat_tuner = demo_messaging.thermostat_tuner:main",
            "census = demo_messaging.census:main",
        ]
    },
)

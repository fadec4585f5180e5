from setuptools import setup

setup(
    name="demo_interactions",
    version="1.0.0",
    description="Services, actions and lifecycle nodes, as ordinary programs.",
    packages=["demo_interactions"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/demo_interactions"]),
        ("share/demo_interactions", ["package.xml"]),
    ],
    entry_points={
        "console_scripts": [
            "adder = demo_interactions.adder:main",
            "asker = demo_interactions.asker:main",
            "blocking_asker = demo_interactions.blocking_asker:main",
            "fibonacci_server = demo_interactions.fibonacci_server:main",
            "fibonacci_client = demo_interactions.fibonacci_client:main",
            "camera = demo_interactions.camera:main",
            "camera_manager = demo_interactions.camera_manager:main",
        ]
    },
)

"""caryatid as a ROS 2 node: `messages` converts, `exploration` decides, `node` talks to ROS."""

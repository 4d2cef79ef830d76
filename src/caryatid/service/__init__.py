"""The same sessions over HTTP, for robot software that lives elsewhere: `caryatid serve`."""

"""Start the node `caryatid`."""

from __future__ import annotations

import os
import signal
import sys


def main() -> None:
    """Run the node until it is stopped; no exception in a callback ends it."""
    node, status = None, 0
    # Ctrl-C during imports must be as quiet as later; extension modules turn it into errors of their own.
    before = signal.signal(signal.SIGINT, lambda *_: os._exit(0))
    try:
        import rclpy
        from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor

        from caryatid.errors import CaryatidError, in_one_line
        from caryatid_ros.server import ExplorationNode

        signal.signal(signal.SIGINT, before)
        rclpy.init()
        try:
            node = ExplorationNode()
            executor = SingleThreadedExecutor()
            executor.add_node(node)
            while rclpy.ok():
                try:
                    executor.spin()
                except ExternalShutdownException:
                    break
                except Exception as error:
                    node.sentence(error)  # which logs it
        except CaryatidError as error:
            status = _refuse(in_one_line(error))
        if node is not None and node.failure:
            status = _refuse(node.failure)
    except KeyboardInterrupt:
        pass
    if node is not None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        node.destroy_node()
    # Threads that compile or compute would go on for seconds; what is acknowledged is on disk.
    sys.stderr.flush()
    os._exit(status)


def _refuse(sentence: str) -> int:
    print(f"error: {sentence}", file=sys.stderr)
    return 1


if __name__ == "__main__":
    main()

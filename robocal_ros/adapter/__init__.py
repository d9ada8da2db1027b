# SPDX-License-Identifier: Apache-2.0
"""What drivers publish of inputs and scanners, as the messages that the nodes read."""

# SPDX-License-Identifier: Apache-2.0
"""What was found, for people: figures and a self-contained page. It states what is simulated."""

# SPDX-License-Identifier: Apache-2.0
"""The page for the people at the line: state, what to do, history, decisions, in a browser."""

"""The cell as a PLC sees it by OPC UA."""

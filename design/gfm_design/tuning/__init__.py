"""The synthesis of gains: free gains, costs, searches, and gains that stabilise a whole box."""

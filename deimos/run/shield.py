"""x"""
SHIELD = "shield.json"

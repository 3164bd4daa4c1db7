"""Office: bring coffee and mail to a desk, through nine rooms with thin walls."""

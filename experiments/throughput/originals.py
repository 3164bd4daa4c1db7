"""Simulate the field's domains in plain Python, as lean stand-ins for their published code.

The stand-ins have the published loops and float arithmetic. They lack the NumPy arrays and the checks, so they are
faster. Each is a generator function `(random) -> iterator`. One `next` is one action of a uniformly random agent, and
a new episode starts when one ends.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from random import Random


def catch_point(random: Random) -> Iterator[list[float]]:
    """Catch Point."""
    while True:
        x, y, tx, ty = (random.uniform(-1.0, 1.0) for _ in range(4))
        vx = vy = 0.0
        misses, reward = 0, 0.0
        for _ in range(25):
            force_x = force_y = 0.0
            catches = random.random() < 0.5
            if not catches:
                angle = math.pi * random.uniform(-1.0, 1.0)
                force_x, force_y = 2.0 * math.sin(angle), 2.0 * math.cos(angle)
            vx, vy = 0.75 * vx + 0.1 * force_x, 0.75 * vy + 0.1 * force_y
            x, y = x + 0.1 * vx, y + 0.1 * vy
            squared = (tx - x) ** 2 + (ty - y) ** 2
            reward = -squared if misses <= 10 else 0.0
            if catches and misses <= 10:
                if squared <= 0.04:
                    reward += 20.0
                else:
                    misses += 1
            yield [vx, vy, tx - x, ty - y, reward]
            if reward > 4.0 or reward == 0.0:
                break


def hard_move(random: Random) -> Iterator[list[float]]:
    """Hard Move with four actuators."""
    directions = [(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)]
    sums = [
        tuple(sum(d[axis] for i, d in enumerate(directions) if k >> (3 - i) & 1) for axis in range(2))
        for k in range(16)
    ]
    largest = max(math.hypot(*motion) for motion in sums)
    motions = [(mx / largest, my / largest) for mx, my in sums]
    while True:
        x, y, tx, ty = (random.uniform(-1.0, 1.0) for _ in range(4))
        vx = vy = 0.0
        for _ in range(30):
            motion, push = motions[random.randrange(16)], 2.0 * random.uniform(-1.0, 1.0)
            vx, vy = 0.75 * vx + 0.1 * push * motion[0], 0.75 * vy + 0.1 * push * motion[1]
            x, y = x + 0.1 * vx, y + 0.1 * vy
            squared = (tx - x) ** 2 + (ty - y) ** 2
            yield [vx, vy, tx - x, ty - y, 20.0 - squared if squared <= 0.04 else -squared]
            if squared <= 0.04:
                break


def moving(random: Random) -> Iterator[list[float]]:
    """Moving."""
    while True:
        tx, ty = random.uniform(-0.9, 0.9), random.uniform(-0.9, 0.9)
        x, y, heading, speed = random.uniform(-1, 1), random.uniform(-1, 1), random.uniform(0, 2 * math.pi), 0.0
        for step in range(1, 202):
            before, action = math.hypot(tx - x, ty - y), random.randrange(3)
            if action == 0:
                speed += 0.5 * random.random()
            elif action == 1:
                heading = (heading + random.uniform(-1.0, 1.0) * math.pi / 2) % (2 * math.pi)
            else:
                speed = 0.0 if speed < 0.1 else speed - 0.1
            x, y = x + 0.005 * speed * math.cos(heading), y + 0.005 * speed * math.sin(heading)
            left = math.hypot(tx - x, ty - y)
            reward, is_over = before - left - 0.001, True
            if left < 0.1 and speed == 0.0:
                reward += 1.0
            elif abs(x) > 1.0 or abs(y) > 1.0 or step > 200:
                reward = -1.0
            else:
                is_over = False
            yield [
                x,
                y,
                speed,
                math.cos(heading),
                math.sin(heading),
                tx,
                ty,
                left,
                float(left <= 0.1),
                step / 200,
                reward,
            ]
            if is_over:
                break


def platform(random: Random) -> Iterator[list[float]]:
    """Platform."""
    left, width = (0.0, 475.0, 985.0), (250.0, 275.0, 50.0)
    while True:
        x, y, vx, vy = 0.0, 40.0, 0.0, 0.0
        enemies = [[230.0, -30.0], [730.0, -30.0]]
        is_over = False
        while not is_over:
            action, before, ticks = random.randrange(3), x, 0
            given = random.random() * (30.0, 720.0, 430.0)[action]
            while True:
                stands = y == 40.0 and any(-20.0 <= x - lo <= wide for lo, wide in zip(left, width, strict=True))
                push_x, push_y = 0.0, -9.8
                if stands and action == 0:
                    push_x, push_y = given / 0.05, 0.0
                elif stands:
                    rise = 35.0 if action == 1 else 25.0
                    wish = min(max(given / (2 * rise / 9.8 + 1) - vx, -600.0), 200.0 - rise)
                    push_x = (wish - abs(random.gauss(0, 1))) / 0.05
                    push_y = (rise - abs(random.gauss(0, 1))) / 0.05
                vx += 0.05 * min(max(push_x, -600.0), 600.0) - abs(random.gauss(0, 0.025))
                vy += 0.05 * min(max(push_y, -4000.0), 4000.0)
                vx, vy = max(min(vx, 100.0), 0.0), min(max(vy, -200.0), 200.0)
                if stands:
                    vx = min(vx, 70.0)
                enemy, lo = enemies[x > 475.0], 475.0 if x > 475.0 else 0.0
                high = lo + (255.0 if x > 475.0 else 230.0)
                x, y, vx = min(max(x + 0.05 * vx, 0.0), 1035.0), y + 0.05 * vy, vx * 0.99
                if not lo < enemy[0] < high:
                    enemy[1] = -enemy[1]
                enemy[1] = min(max(enemy[1] + random.gauss(0, 0.025), -30.0), 30.0)
                enemy[0] = min(max(enemy[0] + 0.05 * enemy[1], lo), high)
                for lo, wide in zip(left, width, strict=True):
                    if lo - 20.0 < x < lo + wide and -30.0 < y < 40.0:
                        new_x = lo - 20.0 if x < lo else lo + wide if x > lo + wide - 20.0 else x
                        new_y = 40.0 if y > 10.0 else y
                        if new_x == x or (new_y != y and abs(x - new_x) >= abs(y - new_y)):
                            y, vy = new_y, 0.0
                        else:
                            x = new_x
                        vx = 0.0
                meets = any(abs(x - ex) < 20.0 and abs(y - 40.0) < 30.0 for ex, _ in enemies)
                is_over = y < 40.0 or meets or x >= 1035.0
                ticks += 1
                landed = y == 40.0 and any(-20.0 <= x - lo <= wide for lo, wide in zip(left, width, strict=True))
                if is_over or (ticks == 20 if action == 0 else landed):
                    break
            yield [x, vx, *enemy, (x - before) / 1035.0]


def goal(random: Random) -> Iterator[list[float]]:
    """Robot Soccer Goal."""

    def accelerate(body: list[float], push: float, angle: float, noise: float, limit: float) -> None:
        angle += angle * noise * random.uniform(-1, 1)
        jolt = noise * math.hypot(body[2], body[3])
        for axis, part in ((2, math.cos(angle)), (3, math.sin(angle))):
            change = min(max(push * part + jolt * random.uniform(-1, 1), -limit), limit)
            body[axis] = min(max(body[axis] + change, -limit), limit)

    while True:
        y = random.uniform(-15.0, 15.0)
        angle = math.atan2(-y, 20.0)
        player, ball = [0.0, y, 0.0, 0.0], [1.59999 * math.cos(angle), y + 1.59999 * math.sin(angle), 0.0, 0.0]
        keeper = [14.5, ball[1] * 5.5 / (20.0 - ball[0]), 0.0, 0.0]
        is_over = False
        for _ in range(99):
            action = random.randrange(3)
            aim_x = aim_y = random.uniform(0.0, 40.0)
            if action:
                aim_x, aim_y = 20.4, random.uniform(-7.01, 7.01)
            while True:
                to_x, to_y = ball[0] - player[0], ball[1] - player[1]
                distance = math.hypot(to_x, to_y)
                turn = math.remainder(math.atan2(to_y, to_x) - angle, 2 * math.pi)
                if distance <= 1.6:
                    wish_x, wish_y = 0.06 * (aim_x - player[0]) - ball[2], 0.06 * (aim_y - player[1]) - ball[3]
                    efficiency = 1 - 0.25 * abs(turn) / math.pi - 0.25 * distance / 1.6
                    push = min(math.hypot(wish_x, wish_y), 2.7 * efficiency)
                    accelerate(ball, push, math.atan2(wish_y, wish_x), 0.05, 2.7)
                elif abs(turn) < math.pi / 8:
                    accelerate(player, 0.06, angle, 0.1, 1.0)
                else:
                    angle += turn / (1 + 5 * math.hypot(player[2], player[3]))
                roll_x, roll_y = ball[2] / 0.06, ball[3] / 0.06
                slope = roll_y / roll_x if roll_x else 0.0
                if ball[0] + roll_x > 20.0 and abs(ball[1] + slope * (20.0 - ball[0])) <= 9.01 and slope:
                    side = roll_x * (ball[1] - keeper[1]) - roll_y * (ball[0] - keeper[0])
                    accelerate(keeper, 0.12, math.atan2(side * roll_x, -side * roll_y), 0.1, 1.0)
                else:
                    way = math.atan2(ball[1] + roll_y - keeper[1], ball[0] + roll_x - keeper[0])
                    accelerate(keeper, 0.048, way, 0.1, 1.0)
                for body, decay in ((player, 0.4), (keeper, 0.4), (ball, 0.94)):
                    body[0], body[1] = body[0] + body[2], body[1] + body[3]
                    body[2], body[3] = body[2] * decay, body[3] * decay
                for one, other, touch in ((player, keeper, 1.8), (player, ball, 1.3), (keeper, ball, 1.3)):
                    apart_x, apart_y = one[0] - other[0], one[1] - other[1]
                    apart = math.hypot(apart_x, apart_y)
                    if 0.0 < apart < touch:
                        fraction = 0.5 * (touch - apart) / apart
                        one[:] = [one[0] + apart_x * fraction, one[1] + apart_y * fraction, -one[2], -one[3]]
                        other[:] = [other[0] - apart_x * fraction, other[1] - apart_y * fraction, -other[2], -other[3]]
                in_net = 20.0 <= ball[0] <= 22.44 and abs(ball[1]) <= 7.01
                caught = math.hypot(keeper[0] - ball[0], keeper[1] - ball[1]) < 2.0
                is_over = in_net or caught or not (0.0 <= ball[0] <= 20.0 and abs(ball[1]) <= 15.0)
                rests = math.hypot(ball[2], ball[3]) <= 0.1
                if is_over or (action == 0 and rests and math.hypot(player[0] - ball[0], player[1] - ball[1]) <= 1.6):
                    break
            yield [*player, angle, *keeper, *ball, 50.0 if in_net else 0.0]
            if is_over:
                break


ORIGINALS = {
    "Goal": goal,
    "Platform": platform,
    "CatchPoint": catch_point,
    "HardMove4": hard_move,
    "Moving": moving,
}

// Example joint controller in Go, with the package github.com/goburrow/modbus: moves the arm to a pose and holds it.
package main

import (
	"encoding/binary"
	"fmt"
	"log"
	"math"
	"os"
	"strconv"
	"time"

	"github.com/goburrow/modbus"
)

const period = 20 * time.Millisecond

var (
	goal   = [4]float64{30, -45, 50, 20}           // degrees, degrees, mm, degrees
	kp     = [4]float64{0.25, 0.25, 0.03, 0.004}   // N·m per degree; joint 3: N per mm
	kd     = [4]float64{0.04, 0.03, 0.002, 0.0005} // N·m per degree/s; joint 3: N per mm/s
	limit  = [4]float64{30, 30, 40, 60}            // a larger error counts as this
	weight = [4]float64{0, 0, -4.905, 0}           // joint 3 carries the quill
)

func main() {
	address, seconds := "127.0.0.1:5020", 10.0
	if len(os.Args) > 1 {
		address = os.Args[1]
	}
	if len(os.Args) > 2 {
		seconds, _ = strconv.ParseFloat(os.Args[2], 64)
	}
	handler := modbus.NewTCPClientHandler(address)
	handler.Timeout = time.Second
	handler.SlaveId = 1
	if err := handler.Connect(); err != nil {
		log.Fatalln("no rig:", err)
	}
	defer handler.Close()
	rig := modbus.NewClient(handler)

	var position, before, speed [4]float64
	ticker := time.NewTicker(period)
	end := time.Now().Add(time.Duration(seconds * float64(time.Second)))
	for first := true; time.Now().Before(end); first = false {
		registers, err := rig.ReadHoldingRegisters(4, 4)
		if err != nil {
			log.Fatalln("reading failed:", err)
		}
		torques := make([]byte, 8)
		for j := range position {
			position[j] = float64(int16(binary.BigEndian.Uint16(registers[2*j:]))) / 100
			if !first {
				speed[j] = 0.5*speed[j] + 0.5*(position[j]-before[j])/period.Seconds()
			}
			torque := kp[j]*math.Max(-limit[j], math.Min(limit[j], goal[j]-position[j])) - kd[j]*speed[j] + weight[j]
			binary.BigEndian.PutUint16(torques[2*j:], uint16(int16(math.Round(1000*torque))))
		}
		before = position
		if _, err := rig.WriteMultipleRegisters(0, 4, torques); err != nil {
			log.Fatalln("writing failed:", err)
		}
		<-ticker.C
	}
	fmt.Println("at the end:", position)
	for j := range goal {
		if math.Abs(goal[j]-position[j]) > 1 {
			os.Exit(1)
		}
	}
}
